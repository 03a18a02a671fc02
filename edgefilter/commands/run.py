"""`edgefilter run`: connect a source, the filter and a sink, show how it goes, say what happened."""

from __future__ import annotations

import argparse
import gc
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from edgefilter.audio.protocols import Sink, Source
from edgefilter.audio.troubles import Troubles
from edgefilter.commands.assembly import check_request, make_filter
from edgefilter.commands.display import describe_latency, say, write_json
from edgefilter.commands.ends import limited, make_sink, make_source, make_speech
from edgefilter.commands.watch import Watch
from edgefilter.errors import EdgefilterError
from edgefilter.filter.budget import Choice
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.session import RunReport, filter_blocks
from edgefilter.types import SAMPLE_RATE

TWICE_S = 0.5
"""Seconds from which on a second signal is one of its own."""


def main(args: argparse.Namespace) -> int:
    speech = make_speech(args)
    source = make_source(args.input, speech or args.reference, args.output)
    ego, choice = make_filter(args, source.live)
    check_request(args, ego, source.live)
    sink = make_sink(args.output, ego.latency, wait=not source.live)
    limit = None if args.seconds is None else round(args.seconds * SAMPLE_RATE)
    notes = [*source.notes, f"engine {ego.engine_name} ({ego.engine_reason}), {describe_latency(ego)}"]
    for note in notes:
        say(note)
    told = len(source.notes)
    watch = Watch(args, ego, source, speech, notes)
    with stop_on_signal(source) as stopped, source, sink, watch, garbage_of_this_run_only():
        report = filter_blocks(
            limited(source, limit),
            ego,
            sink,
            watch.record,
            watch.show,
            lambda: bool(stopped) or sink.finished,
            watch.hear,
            Troubles(source, sink),
        )
        report.interrupted |= bool(stopped)
    return finish(args, ego, choice, (source, sink, watch), report, told)


def finish(
    args: argparse.Namespace,
    ego: EgoFilter,
    choice: Choice | None,
    ends: tuple[Source, Sink, Watch],
    report: RunReport,
    told: int,
) -> int:
    """Say and write what happened; return the exit code."""
    source, sink, watch = ends
    for note in [*source.notes[told:], *sink.notes]:
        say(note)
    figures = report.to_dict() | {"choice": choice.to_dict() if choice else None}
    figures |= {"source": source.stats(), "sink": sink.stats(), "notes": [*source.notes, *sink.notes]}
    failure = report.failure
    endings = (
        (partial(write_json, figures), args.json),
        (partial(save_profile, ego), args.save_profile),
        (lambda _: watch.finish(figures), True),
        (lambda _: ego.close(), True),
    )
    for write, path in endings:
        try:
            if path:
                write(path)
        except EdgefilterError as error:  # what else there is to write is still written
            failure = failure or error
    if failure:
        raise failure
    seconds = report.samples_in / SAMPLE_RATE
    factor = f", {report.process_s / seconds:.3f} of real time" if seconds else ""
    how = "stopped after" if report.interrupted else "filtered"
    missed = f", {report.filter['deadline']['missed_deadlines']} deadlines missed" if source.live else ""
    say(
        f"{how} {seconds:.1f} s in {report.wall_s:.1f} s{factor}; {report.samples_out} samples to {args.output},"
        f" {report.lost} lost{missed}"
    )
    return 130 if report.interrupted and not source.live else 0


def save_profile(ego: EgoFilter, path: str) -> None:
    """Write the adapted profile and say which effects have become part of its path."""
    adapted = ego.adapted_profile()
    adapted.save(path)
    left = {name for name, _ in adapted.echo.effects}
    before = ego.profile.echo.effects if ego.profile else ()
    held = ", ".join(name for name, _ in before if name not in left)
    say(f"the adapted path is in {path}" + (f"; {held} is part of it now and no longer listed" if held else ""))


@contextmanager
def garbage_of_this_run_only() -> Iterator[None]:
    """Keep the garbage collector from what was there before: looking through all modules takes 13 to 20 ms, more than a hop lasts."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def stop_on_signal(source: Source) -> Iterator[list[int]]:
    """SIGINT and SIGTERM end the source, and with it the run, in good order; the list then holds the signal.

    A later one ends it at once: nobody may be reading the pipe that the first waits for. (Not one that comes with the
    first: timeout(1) signals a program and its group.)
    """
    caught: list[int] = []
    first_at = 0.0

    def handle(number: int, _frame: object) -> None:
        nonlocal first_at
        if caught and time.monotonic() - first_at > TWICE_S:
            raise KeyboardInterrupt
        first_at = first_at or time.monotonic()
        caught.append(number)
        source.stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
