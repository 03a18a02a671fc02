"""`edgefilter run`: connect a source, the filter and a sink, show how it goes, say what happened."""

from __future__ import annotations

import argparse
import gc
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from edgefilter.audio.files import FileSink, Recorder, open_source
from edgefilter.audio.protocols import Sink, Source
from edgefilter.audio.raw import PcmSink
from edgefilter.commands.display import describe_latency, display, write_json
from edgefilter.engines import HAVE_LINEAR_STAGE
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.budget import DEFAULT_MS, Choice, choose
from edgefilter.filter.budget_cache import forget
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.learner import Learner
from edgefilter.learning.background import LEAST_CORES, BackgroundLearner, cores
from edgefilter.profile.data import Profile
from edgefilter.session import RunReport, filter_blocks
from edgefilter.types import SAMPLE_RATE, Event

FILE_ENDINGS = (".wav", ".flac", ".ogg", ".mp3", ".aiff", ".aif", ".w64", ".opus", ".txt", ".raw", ".pcm")


def main(args: argparse.Namespace) -> int:
    source = make_source(args.input, args.reference, args.output)
    ego, choice = make_filter(args, source.live)
    if ego.waits_for_end and source.live:
        raise UsageError(
            f"engine {ego.engine_name} needs the whole recording before it answers: give --input FILE or take another"
            " engine"
        )
    if args.save_profile and not ego.can_adapt:
        names = ", ".join(HAVE_LINEAR_STAGE)
        needed = f"give --profile and an engine with a linear stage ({names})"
        raise UsageError(f"--save-profile writes back an adapted path: {needed}")
    if args.learn and ego.stats()["linear_stage"] is None:
        names = ", ".join(HAVE_LINEAR_STAGE)
        raise UsageError(
            f"--learn keeps what a linear stage has learned, which {ego.engine_name} lacks: take one of {names}"
        )
    sink = make_sink(args.output, ego.latency, wait=not source.live)
    limit = None if args.seconds is None else round(args.seconds * SAMPLE_RATE)
    for note in source.notes:
        say(note)
    say(f"engine {ego.engine_name} ({ego.engine_reason}), {describe_latency(ego)}")
    told = len(source.notes)
    with ExitStack() as stack:
        stopped = stack.enter_context(stop_on_signal(source))
        stack.enter_context(source)
        stack.enter_context(sink)
        recorder = stack.enter_context(Recorder(args.save_input)) if args.save_input else None
        show = stack.enter_context(display(source, args.quiet))
        stack.enter_context(garbage_of_this_run_only())
        report = filter_blocks(
            limited(source, limit),
            ego,
            sink,
            recorder,
            show,
            lambda: bool(stopped) or sink.finished,
            partial(say_event, live=source.live),
        )
        report.interrupted |= bool(stopped)
    return finish(args, ego, choice, source, sink, report, told)


def make_filter(args: argparse.Namespace, live: bool) -> tuple[EgoFilter, Choice | None]:
    """The filter with the engine that was asked for, or with the one that the measurement chose.

    Live, or where a budget is given, "auto" is measured; a recording has no deadline and gets the strongest engine at
    once. Live, an engine that was chosen or that has a budget may be replaced by cheaper ones while it runs.
    """
    if args.remeasure:
        forget()
    choice, engine, reason, budget_ms = None, args.engine, "asked for", args.budget_ms
    profile = starting_profile(args)
    if engine == "auto" and not args.model and (live or budget_ms):
        choice = choose(budget_ms or DEFAULT_MS, profile, say=say)
        engine, reason, budget_ms = choice.engine, choice.reason, choice.budget_ms
    learner = make_learner(args, live, profile)
    ego = EgoFilter(profile, engine, budget_ms if live else None, reason, args.model, learn=learner)
    if profile is None and ego.engine_name in HAVE_LINEAR_STAGE:
        say(UNCALIBRATED)
    return ego, choice


def starting_profile(args: argparse.Namespace) -> Profile | None:
    """What was learned before, where there is such a file; else the calibration, where one was given."""
    if args.learn and Path(args.learn).exists():
        return Profile.load(args.learn)
    return Profile.load(args.profile) if args.profile else None


def make_learner(args: argparse.Namespace, live: bool, profile: Profile | None) -> Learner | None:
    """A learner in another process for a live run, in this one for a recording; none where it would take the filter's core."""
    if args.no_learn:
        return None
    remember = Path(args.learn) if args.learn else None
    if not live:
        from edgefilter.learning.path_learner import PathLearner

        return PathLearner(profile, remember)
    if cores() < LEAST_CORES:
        say("one core only: loudspeaker and room are not learned while running")
        return None
    return BackgroundLearner(profile, remember)


UNCALIBRATED = (
    "no profile: uncalibrated, the room is learnt from the robot's first seconds ('edgefilter calibrate' measures it"
    " beforehand)"
)


def finish(
    args: argparse.Namespace,
    ego: EgoFilter,
    choice: Choice | None,
    source: Source,
    sink: Sink,
    report: RunReport,
    told: int,
) -> int:
    """Say and write what happened; return the exit code."""
    for note in [*source.notes[told:], *sink.notes]:
        say(note)
    figures = report.to_dict() | {"choice": choice.to_dict() if choice else None}
    figures |= {"source": source.stats(), "sink": sink.stats(), "notes": [*source.notes, *sink.notes]}
    failure = report.failure
    endings = (
        (partial(write_json, figures), args.json),
        (partial(save_profile, ego), args.save_profile),
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


def make_source(name: str, reference: str | None, output: str) -> Source:
    """A file or pipe where name is one, else the live devices.

    The reference defaults to the monitor of the output device.
    """
    if name == "-" or looks_like_file(name):
        return open_source(name, reference)
    from edgefilter.audio.device import LiveSource, monitor_of

    if reference and looks_like_file(reference):
        raise UsageError(
            f"live, the reference is a device, found the file {reference}: leave --reference out or name a monitor"
            " ('edgefilter devices')"
        )
    return LiveSource(name, reference or monitor_of("default" if output == "-" or looks_like_file(output) else output))


def make_sink(name: str, latency: int, wait: bool) -> Sink:
    """A file or pipe where name is one, else an output device, which gets the latency as silence first.

    wait: let a device that plays slower hold back the source, which a recording can bear and a microphone cannot.
    """
    if name == "-":
        return PcmSink()
    if looks_like_file(name):
        return FileSink(name)
    from edgefilter.audio.device import LiveSink

    return LiveSink(name, latency, wait=wait)


def looks_like_file(name: str) -> bool:
    """Whether people who type this mean a file: it exists, has an audio ending, or has a folder in it."""
    return Path(name).exists() or name.lower().endswith(FILE_ENDINGS) or "/" in name


def limited(source: Source, limit: int | None) -> Iterator:
    """The blocks of source up to limit samples; the last one is cut."""
    left = limit
    for block in source:
        if left is not None and block.mic.size >= left:
            source.stop()
            yield type(block)(block.mic[:left], block.ref[:left], block.start, block.lost)
            return
        left = None if left is None else left - block.mic.size
        yield block


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
    """SIGINT and SIGTERM end the source, and with it the run, in good order; the list then holds the signal."""
    caught: list[int] = []

    def handle(number: int, _frame: object) -> None:
        caught.append(number)
        source.stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def say(text: str) -> None:
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
