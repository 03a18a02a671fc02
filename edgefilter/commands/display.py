"""What a person sees while a run goes on: a progress bar for recordings, a status line for live audio."""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from tqdm import tqdm

from edgefilter.audio.protocols import Source
from edgefilter.errors import AudioFileError, UsageError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.session import Progress
from edgefilter.types import SAMPLE_RATE, Event, Stats

STATUS_PERIOD_S = 0.2


TOLD = ("stepped_down", "stepped_up", "overloaded", "learned", "unlearned", "device_gone", "device_back")
"""Kinds of events that every run tells of."""


def say(text: str) -> None:
    """One line for the person who runs it, on standard error: standard output may be sound."""
    print(text, file=sys.stderr)


def countdown(what: str) -> Callable[[float], None]:
    """Say what is going on; on a terminal, the function that is returned shows the seconds that are left."""
    if not sys.stderr.isatty():
        say(what)
        return lambda left_s: None
    shown = -1

    def show(left_s: float) -> None:
        nonlocal shown
        if shown != (shown := math.ceil(left_s)):
            print(f"\r{what}, {shown} s left ", end="" if shown else "\n", file=sys.stderr, flush=True)

    return show


def interject(text: str) -> None:
    """A line while a run goes, below the status line where that is shown."""
    say(f"{chr(10) if sys.stderr.isatty() else ''}{text}")


def say_event(event: Event, live: bool) -> None:
    """Tell of a change of engine or path, or a device that went or came, when it happens.

    Live, also of the human's speech.
    """
    if event.kind in TOLD or (live and event.kind.startswith("speech")):
        interject(f"{event.sample / SAMPLE_RATE:.1f} s: {event.kind.replace('_', ' ')} {event.detail}")


def describe_latency(ego: EgoFilter) -> str:
    """The algorithmic latency in words."""
    return (
        "answers at the end of the recording"
        if ego.waits_for_end
        else f"algorithmic latency {1000 * ego.latency / SAMPLE_RATE:.0f} ms"
    )


@contextmanager
def display(source: Source, ego: EgoFilter, quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """Give a function to call after each block."""
    if quiet:
        yield lambda progress: None
    elif source.live:
        yield from _status(source, ego)
    else:
        yield from _bar(source.total)


def _bar(total: int | None) -> Iterator[Callable[[Progress], None]]:
    form = "{percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s  {elapsed}<{remaining}" if total else "{n:.0f} s  {elapsed}"
    with tqdm(
        total=total / SAMPLE_RATE if total else None, bar_format=form, delay=1.0, leave=False, disable=None
    ) as bar:
        yield lambda progress: bar.update(progress.samples / SAMPLE_RATE - bar.n)


def _status(source: Source, ego: EgoFilter) -> Iterator[Callable[[Progress], None]]:
    shown = 0.0
    terminal = sys.stderr.isatty()

    def show(progress: Progress) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown >= STATUS_PERIOD_S and terminal:
            shown = now
            line = status_line(progress, ego.stats(), source.stats(), _width() - 1)
            print("\r" + line, end="", file=sys.stderr, flush=True)

    yield show
    if terminal:
        print(file=sys.stderr)


def _width() -> int:
    """Columns of the terminal behind standard error."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns
    except OSError:
        return 80


def status_line(progress: Progress, stats: Stats, source: Mapping[str, int], width: int) -> str:
    """How it goes, in one line of this width: what does not fit at its end is left out, the bars of the levels before it."""
    minutes, seconds = divmod(progress.samples / SAMPLE_RATE, 60)
    levels = {"mic": progress.mic_db, "robot": progress.ref_db, "out": progress.out_db}
    plain = " ".join(f"{name} {level:.0f}" for name, level in levels.items()) + " dB"
    bars = "  ".join(f"{name} {_bar_of(level)} {level:4.0f} dB" for name, level in levels.items())
    late = stats["deadline"]["missed_deadlines"] if stats["deadline"] else 0
    overruns = sum(count for name, count in source.items() if name.endswith("overruns"))
    words = [f"{stats['engine']} {100 * progress.load:.0f} %", f"late {late}"]
    words += [f"lost {progress.lost}", f"overruns {overruns}"]
    if progress.residual_db is not None:
        words.append(f"residual {progress.residual_db:.0f} dB")
    if alignment := stats["alignment"]:
        delay = alignment.get("delay_samples")
        words.append("lag -" if delay is None else f"lag {1000 * delay / SAMPLE_RATE:.1f} ms")
        words.append(f"drift {alignment.get('ppm', 0.0):+.0f} ppm")
    if stats["learning"]:
        words.append(f"learned {stats['learning'].get('learned', 0)}")
    clock = f"{minutes:02.0f}:{seconds:04.1f}"
    line = "  ".join((clock, bars, *words))
    return (line if len(line) <= width else "  ".join((clock, plain, *words)))[:width].ljust(width)


def _bar_of(level_db: float, width: int = 10) -> str:
    filled = round(width * min(max((level_db + 60) / 60, 0), 1))
    return "#" * filled + "." * (width - filled)


def report_part(name: str) -> ModuleType:
    """The module edgefilter.report.NAME; raises UsageError, which says what to install, where a package is missing."""
    try:
        return importlib.import_module(f"edgefilter.report.{name}")
    except ModuleNotFoundError as error:
        remedy = "pip install 'edgefilter[report]'"
        raise UsageError(f"pictures and reports need {error.name}, which is not installed: {remedy}") from None


def write_json(data: object, path: str) -> None:
    """Write data as JSON to a file, or to standard output for '-'; a list of nothing but numbers and words in one line."""
    text = json.dumps(data, indent=1, allow_nan=False, default=float)
    text = re.sub(r"\[\n\s+[^][{}]*?\n\s*\]", lambda found: re.sub(r"\n\s*", " ", found[0]), text)
    if path == "-":
        print(text)
        return
    try:
        Path(path).write_text(text + "\n")
    except OSError as error:
        raise AudioFileError(
            f"cannot write {path}: {error.strerror}: choose a folder that exists and can be written"
        ) from None
