"""What a person sees: notes and progress on standard error, results on standard output or as JSON, the status line of a run."""

from __future__ import annotations

import argparse
import ctypes
import importlib
import json
import math
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING

from edgefilter.audio.files import whole
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, SET_UP_WRONG, Event, Stats

if TYPE_CHECKING:
    from edgefilter.audio.protocols import Source
    from edgefilter.filter.ego_filter import EgoFilter
    from edgefilter.session import Progress

STATUS_PERIOD_S = 0.2
"""Time between two updates of a line on a terminal: as often as figures can be read."""
LINE_PERIOD_S = 5.0
"""Time between two lines of progress where standard error is a file or a pipe."""
TOLD = (
    *("stepped_down", "stepped_up", "overloaded", "learned", "unlearned", "device_gone", "device_back"),
    *SET_UP_WRONG,
)
"""Kinds of events that are shown in every run; the beginning and end of the human's speech only in a live one."""
STATUS_LEGEND = """\
The status line of a live run:
  mic, robot, out    level of microphone, reference and output, dB of full scale
  crnn 23 %          the engine at work, and its computing time in per cent of the duration of the sound
  late 5             hops whose computing took longer than the hop lasts (16 ms with most engines)
  lost 7             samples that no device delivered; silence replaces them
  overruns 3         blocks before which a device reported that it had dropped sound
  residual -25 dB    output against microphone while the robot talks and no human does: what is left of the robot
  lag 43.1 ms        delay of the robot's voice in the microphone after the reference ("-": not found yet)
  drift +12 ppm      how much faster the microphone's clock runs than the reference's
  learned 2          echo paths that were learned during the run and taken over by the filter"""


def say(text: str) -> None:
    """One line for the person who runs it, on standard error: standard output may be sound.

    A terminal that is gone ends neither the run nor the command.
    """
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)


@contextmanager
def own_words_only() -> Iterator[None]:
    """Keep off the terminal what C libraries print by themselves, such as PortAudio's threads when a sound server ends.

    They print to C's stderr, which in glibc is a variable; other C libraries' is left alone. Python's standard error,
    and that of other programs, is the same file by another way.
    """
    if sys.platform != "linux" or not hasattr(c := ctypes.CDLL(None), "gnu_get_libc_version"):
        yield
        return
    stream = ctypes.c_void_p.in_dll(c, "stderr")
    before = stream.value
    stream.value = _nowhere() or before
    try:
        yield
    finally:
        stream.value = before


@cache
def _nowhere() -> int | None:
    """A stream of C's that ends in nothing; it is never closed, since a thread of a library may still hold it."""
    c = ctypes.CDLL(None)
    c.fopen.restype = ctypes.c_void_p
    return c.fopen(os.devnull.encode(), b"w")


def countdown(what: str) -> Callable[[float], None]:
    """Say what is going on; on a terminal, the function that is returned shows the seconds that are left."""
    if not sys.stderr.isatty():
        say(what)
        return lambda left_s: None
    shown = -1

    def show(left_s: float) -> None:
        nonlocal shown
        if shown != (shown := math.ceil(left_s)):
            _overwrite(f"{what}, {shown} s left")
            if not shown:
                say("")

    return show


def interject(text: str) -> None:
    """A line during a run, below the status line where that is shown."""
    say(f"{chr(10) if sys.stderr.isatty() else ''}{text}")


def say_event(event: Event, live: bool) -> None:
    """Show an event when it happens if it is of a kind in TOLD or, live, the beginning or end of the human's speech."""
    if event.kind in TOLD or (live and event.kind in ("speech_started", "speech_stopped")):
        interject(f"{event.sample / SAMPLE_RATE:.1f} s: {event.kind.replace('_', ' ')} {event.detail}")


def describe_latency(ego: EgoFilter) -> str:
    """The algorithmic latency in a few words."""
    if ego.waits_for_end:
        return "answers at the end of the recording"
    return f"algorithmic latency {1000 * ego.latency / SAMPLE_RATE:.0f} ms"


@contextmanager
def progress(task: str, at_once: bool = True) -> Iterator[Callable[[str], None]]:
    """Show on standard error for how long a task has run and what is being done; gives a function that takes the step.

    On a terminal it is one line that is updated and removed in the end, elsewhere a line every LINE_PERIOD_S. at_once:
    whether the first one comes at the beginning or only after that time.
    """
    began, shown, over = time.monotonic(), [task], threading.Event()
    terminal = sys.stderr.isatty()

    def tell() -> None:
        ended = over.wait(0.0 if at_once else LINE_PERIOD_S)
        while not ended:
            line = f"{time.monotonic() - began:4.0f} s  {shown[0]}"
            _overwrite(line) if terminal else say(line)
            ended = over.wait(STATUS_PERIOD_S if terminal else LINE_PERIOD_S)
        if terminal:
            _overwrite("")

    thread = threading.Thread(target=tell, daemon=True)
    try:
        thread.start()
        yield lambda step: shown.__setitem__(0, f"{task}: {step}")
    finally:
        over.set()
        with suppress(RuntimeError):  # an interrupt came before it had begun: it will say nothing
            thread.join()


def _overwrite(line: str) -> None:
    """Put a line in the place of the one that a terminal shows, cut to its width."""
    width = _width() - 1
    with suppress(OSError):
        print(f"\r{line[:width]:{width}}\r{line[:width]}", end="", file=sys.stderr, flush=True)


def _width() -> int:
    """Columns of the terminal behind standard error."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns
    except OSError:
        return 80


@contextmanager
def display(source: Source, ego: EgoFilter, quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """Give a function to call after each block: it shows the status line of a live run, the progress of a recording."""
    if quiet:
        yield lambda block: None
    elif source.live:
        yield from _status(source, ego)
    else:
        whole = f" of {source.total / SAMPLE_RATE:.0f} s" if source.total else " s"
        with progress("filtering", at_once=False) as step:
            yield lambda block: step(f"{block.samples / SAMPLE_RATE:.0f}{whole}")


def _status(source: Source, ego: EgoFilter) -> Iterator[Callable[[Progress], None]]:
    shown = 0.0
    terminal = sys.stderr.isatty()

    def show(block: Progress) -> None:
        nonlocal shown
        if terminal and time.monotonic() - shown >= STATUS_PERIOD_S:
            shown = time.monotonic()
            _overwrite(status_line(block, ego.stats(), source.stats(), _width() - 1))

    yield show
    if terminal:
        say("")


def status_line(block: Progress, stats: Stats, source: Mapping[str, int], width: int) -> str:
    """How a live run goes, as STATUS_LEGEND explains, in one line of this width.

    Where it does not fit, the bars of the levels are left out, then what stands at its end.
    """
    minutes, seconds = divmod(block.samples / SAMPLE_RATE, 60)
    levels = {"mic": block.mic_db, "robot": block.ref_db, "out": block.out_db}
    plain = " ".join(f"{name} {level:.0f}" for name, level in levels.items()) + " dB"
    bars = "  ".join(f"{name} {_bar_of(level)} {level:4.0f} dB" for name, level in levels.items())
    late = stats["deadline"]["missed_deadlines"] if stats["deadline"] else 0
    overruns = sum(count for name, count in source.items() if name.endswith("overruns"))
    parts = [f"{stats['engine']} {100 * block.load:.0f} %", f"late {late}"]
    parts += [f"lost {block.lost}", f"overruns {overruns}"]
    if block.residual_db is not None:
        parts.append(f"residual {block.residual_db:.0f} dB")
    if alignment := stats["alignment"]:
        delay = alignment.get("delay_samples")
        parts.append("lag -" if delay is None else f"lag {1000 * delay / SAMPLE_RATE:.1f} ms")
        parts.append(f"drift {alignment.get('ppm', 0.0):+.0f} ppm")
    if stats["learning"]:
        parts.append(f"learned {stats['learning'].get('learned', 0)}")
    clock = f"{minutes:02.0f}:{seconds:04.1f}"
    line = "  ".join((clock, bars, *parts))
    return (line if len(line) <= width else "  ".join((clock, plain, *parts)))[:width].ljust(width)


def _bar_of(level_db: float) -> str:
    return ("#" * round(10 * min(max((level_db + 60) / 60, 0), 1))).ljust(10, ".")


def report_part(name: str) -> ModuleType:
    """The module edgefilter.report.NAME; raises UsageError, which says what to install, where a package is missing."""
    try:
        return importlib.import_module(f"edgefilter.report.{name}")
    except ModuleNotFoundError as error:
        remedy = "pip install matplotlib jinja2"
        raise UsageError(f"pictures and reports need {error.name}, which is not installed: {remedy}") from None


def print_result(args: argparse.Namespace, lines: Iterable[str], figures: object = None) -> None:
    """Write the figures to where --json says, if given, and the lines to standard output unless JSON goes there."""
    if args.json and figures is not None:
        write_json(figures, args.json)
    if args.json != "-":
        for line in lines:
            print(line)


def write_json(data: object, path: str) -> None:
    """Write data as JSON to a file, or to standard output for '-'; a list of nothing but numbers and words in one line."""
    text = json.dumps(data, indent=1, allow_nan=False, default=float)
    text = re.sub(r"\[\n\s+[^][{}]*?\n\s*\]", lambda found: re.sub(r"\n\s*", " ", found[0]), text)
    if path == "-":
        print(text)
        return
    with whole(path, "the JSON") as file:
        file.write(f"{text}\n".encode())
