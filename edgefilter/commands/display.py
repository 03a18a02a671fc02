"""What a person sees while a run goes on: a progress bar for recordings, a level meter for live audio."""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from tqdm import tqdm

from edgefilter.audio.protocols import Source
from edgefilter.errors import AudioFileError, UsageError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.session import Progress
from edgefilter.types import SAMPLE_RATE, Event

METER_PERIOD_S = 0.1


def say(text: str) -> None:
    """One line for the person who runs it, on standard error: standard output may be sound."""
    print(text, file=sys.stderr)


def say_event(event: Event, live: bool) -> None:
    """Tell of a change of engine or path when it happens, below the level meter where that is shown.

    Live, also of the human's speech.
    """
    if event.kind in ("stepped_down", "stepped_up", "overloaded", "learned", "unlearned") or (
        live and event.kind.startswith("speech")
    ):
        say(
            f"{chr(10) if sys.stderr.isatty() else ''}{event.sample / SAMPLE_RATE:.1f} s:"
            f" {event.kind.replace('_', ' ')} {event.detail}"
        )


def describe_latency(ego: EgoFilter) -> str:
    """The algorithmic latency in words."""
    return (
        "answers at the end of the recording"
        if ego.waits_for_end
        else f"algorithmic latency {1000 * ego.latency / SAMPLE_RATE:.0f} ms"
    )


@contextmanager
def display(source: Source, quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """Give a function to call after each block."""
    if quiet:
        yield lambda progress: None
    elif source.live:
        yield from _meter()
    else:
        yield from _bar(source.total)


def _bar(total: int | None) -> Iterator[Callable[[Progress], None]]:
    form = "{percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s  {elapsed}<{remaining}" if total else "{n:.0f} s  {elapsed}"
    with tqdm(
        total=total / SAMPLE_RATE if total else None, bar_format=form, delay=1.0, leave=False, disable=None
    ) as bar:
        yield lambda progress: bar.update(progress.samples / SAMPLE_RATE - bar.n)


def _meter() -> Iterator[Callable[[Progress], None]]:
    shown = 0.0
    terminal = sys.stderr.isatty()

    def show(progress: Progress) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown >= METER_PERIOD_S and terminal:
            shown = now
            print("\r" + meter_line(progress), end="", file=sys.stderr, flush=True)

    yield show
    if terminal:
        print(file=sys.stderr)


def meter_line(progress: Progress) -> str:
    """One line: elapsed time, the three levels as bars and dB, what was lost."""
    minutes, seconds = divmod(progress.samples / SAMPLE_RATE, 60)
    levels = [("mic", progress.mic_db), ("robot", progress.ref_db), ("out", progress.out_db)]
    bars = "  ".join(f"{name} {_bar_of(level)} {level:4.0f} dB" for name, level in levels)
    return f"{minutes:02.0f}:{seconds:04.1f}  {bars}  lost {progress.lost} "


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
    """Write data as JSON to a file, or to standard output for '-'."""
    text = json.dumps(data, indent=1, allow_nan=False, default=float)
    if path == "-":
        print(text)
        return
    try:
        Path(path).write_text(text + "\n")
    except OSError as error:
        raise AudioFileError(
            f"cannot write {path}: {error.strerror}: choose a folder that exists and can be written"
        ) from None
