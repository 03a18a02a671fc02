"""`edgefilter run`: connect a source, the filter and a sink, show how it goes, say what happened."""

from __future__ import annotations

import argparse
import gc
import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from edgefilter.audio import pulse, virtual
from edgefilter.audio.channels import Channels
from edgefilter.audio.device import find, monitor_of, speaker
from edgefilter.audio.files import form_of, open_sink, open_source
from edgefilter.audio.live import LiveSink, LiveSource
from edgefilter.audio.port import SpokenReference
from edgefilter.audio.protocols import Sink, Source, Troubles
from edgefilter.audio.reader import Reader
from edgefilter.audio.steady import SteadySink
from edgefilter.commands.display import describe_latency, say, write_json
from edgefilter.commands.observers import Observers, observing
from edgefilter.commands.signals import on_signal
from edgefilter.engines import HAVE_LINEAR_STAGE
from edgefilter.errors import EdgefilterError, SignalError, UsageError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.budget import DEFAULT_MS, Choice, allowed_cores, choose, forget
from edgefilter.filter.echo_path import Learner
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.learning.background import BackgroundLearner
from edgefilter.profile.data import Profile
from edgefilter.session import RunReport, Verdict, filter_blocks
from edgefilter.types import SAMPLE_RATE, Block

FILE_ENDINGS = (
    *(".wav", ".flac", ".ogg", ".mp3", ".aiff", ".aif", ".w64", ".opus", ".txt", ".raw", ".pcm"),
    *(".m4a", ".mp4", ".aac", ".3gp", ".amr", ".webm", ".mkv", ".wma"),
)


def main(args: argparse.Namespace) -> int:
    check_output(args.output)
    speech = make_speech(args)
    file = args.learn if args.learn and Path(args.learn).exists() else args.profile
    profile = Profile.load(file) if file else None
    channels = channels_of(args, profile)
    source = make_source(args, speech, channels)
    check_asking(args, source)
    if channels is not None and args.mic_channels is None:
        source.notes.append(f"all {source.microphones} channels are microphones, since the profile is of an array")
    ego, choice = make_filter(args, source.live, profile)
    check_request(args, ego, source)
    sink = make_sink(args.output, ego.latency, wait=not source.live)
    limit = None if args.seconds is None else round(args.seconds * SAMPLE_RATE)
    notes = [*source.notes, f"engine {ego.engine_name} ({ego.engine_reason}), {describe_latency(ego)}"]
    for note in notes:
        say(note)
    told = len(source.notes)
    observed = observing(args, ego, source, speech, notes)
    # a later signal ends the run at once: nobody may be reading the pipe that the first waits for
    with on_signal(source.stop) as stopped, source, sink, observed as observers, garbage_of_this_run_only():
        report = filter_blocks(
            limited(source, limit),
            ego,
            sink,
            recorder=observers.record,
            show=observers.show,
            stopped=lambda: bool(stopped) or sink.finished,
            tell=observers.hear,
            troubles=Troubles(source, sink),
            due=source.total is None,
        )
        report.interrupted |= bool(stopped)
    for note in [*source.notes[told:], *sink.notes]:
        say(note)
    if (report.filter["learning"] or {}).get("process") == "ended":
        say("the learner's process ended before the run: from then on nothing was learned")
    figures = report.to_dict() | {"choice": choice.to_dict() if choice else None}
    figures |= {"source": source.stats(), "sink": sink.stats(), "notes": [*source.notes, *sink.notes]}
    _write_results(args, ego, observers, report, figures)
    missed = f", {report.filter['deadline']['missed_deadlines']} deadlines missed" if source.live else ""
    _say_end(args, report, missed)
    return 130 if report.interrupted and not source.live else 0


def check_output(name: str) -> None:
    """Raise UsageError where name is no pipe and neither a file that can be written nor, if it has a dot in it, a device."""
    if not is_device(name):
        if name != "-" and not Path(name).is_fifo():
            form_of(Path(name))
    elif Path(name).suffix:
        try:
            find(name, "output")
        except EdgefilterError as error:
            raise UsageError(f"output {name} is no file, which ends in .wav or .flac, and no device: {error}") from None


def make_speech(args: argparse.Namespace) -> SpokenReference | None:
    """The speech that the run itself plays, None where no --play asks for it."""
    if args.play is None:
        given = {"--speaker": args.speaker, "--barge-in": args.barge_in}
        if option := next((option for option, value in given.items() if value is not None), None):
            raise UsageError(f"{option} concerns the speech that --play plays, found none: give --play FILE")
        return None
    live = is_device(args.input)
    if not live or args.reference is not None:
        found = f"--reference {args.reference}" if live else f"--input {args.input}"
        raise UsageError(
            f"--play plays the robot's speech to a live microphone and is the reference itself, found {found}: give"
            " --input mic and no --reference"
        )
    return speaker(args.speaker, Reader(args.play, "speech"))


def channels_of(args: argparse.Namespace, profile: Profile | None) -> Channels | None:
    """The channels that are named; where none are, live, and the profile is of several microphones: all that the device has.

    Raises UsageError for a reference channel without or among microphones, and beside another reference.
    """
    if args.reference_channel is not None and (args.reference is not None or args.play is not None):
        other = "--play" if args.play is not None else "--reference"
        raise UsageError(f"--reference-channel is the reference, found {other} too: leave one of them out")
    named = Channels.named(args.mic_channels, args.reference_channel)
    return Channels() if named is None and profile and profile.microphones > 1 and is_device(args.input) else named


def make_source(args: argparse.Namespace, speech: SpokenReference | None, channels: Channels | None) -> Source:
    """A file or pipe where --input is one, else the live devices.

    The reference defaults to the monitor of the output device, for the virtual microphone to that of its speaker.
    """
    if not is_device(args.input):
        return open_source(args.input, args.reference, channels)
    if args.reference is not None and looks_like_file(args.reference):
        raise UsageError(
            f"live, the reference is a device, found the file {args.reference}: leave --reference out or name a monitor"
            " ('edgefilter devices'); to play the file, --play"
        )
    mic = find(args.input, "input")
    virtual.refuse_own(mic)
    reference = speech or args.reference
    if reference is None and args.reference_channel is None:
        own = pulse.monitor(virtual.SPEAKER) if args.output == virtual.HUMAN else None
        played_on = args.output if is_device(args.output) and args.output != virtual.HUMAN else "default"
        reference = own or monitor_of(played_on)
    return LiveSource(mic, reference, patience_s=math.inf, channels=channels)


def check_asking(args: argparse.Namespace, source: Source) -> None:
    """Raise UsageError where the robot is to be asked to lower its voice, and nobody can lower it."""
    if args.ask_db and args.play is None and not source.monitored:
        found = "a recording" if not source.live else "a reference that is no monitor of the sound server"
        raise UsageError(
            f"--ask-db lowers what --play plays, or what programs play on an output of the sound server, found {found}:"
            " give --input mic, and --play FILE or the monitor of an output as --reference ('edgefilter devices')"
        )


def make_sink(name: str, latency: int, wait: bool) -> Sink:
    """A file or pipe where name is one, else an output device, which gets the latency as silence first.

    wait: let a device that plays slower hold back the source, which a recording can bear and a microphone cannot.
    """
    if not is_device(name):
        return open_sink(name)
    return LiveSink(name, latency, wait=True) if wait else SteadySink(lambda: LiveSink(name, latency, wait=False))


def is_device(name: str) -> bool:
    """Whether an input or output is neither a pipe nor a file."""
    return name != "-" and not looks_like_file(name)


def looks_like_file(name: str) -> bool:
    """Whether people who type this mean a file: it exists, has an audio ending, or has a folder in it."""
    return Path(name).exists() or name.lower().endswith(FILE_ENDINGS) or "/" in name


def limited(source: Source, limit: int | None) -> Iterator[Block]:
    """The blocks of source up to limit samples; the last one is cut."""
    left = limit
    for block in source:
        if left is not None and block.ref.size >= left:
            source.stop()
            yield Block(block.mic[:left], block.ref[:left], block.start, block.lost)
            return
        left = None if left is None else left - block.ref.size
        yield block


def make_filter(args: argparse.Namespace, live: bool, profile: Profile | None) -> tuple[EgoFilter, Choice | None]:
    """The filter with the engine that was asked for, or with the one that the measurement chose.

    Live, or where a budget is given, "auto" is measured; a recording has no deadline and gets the strongest engine at
    once. Live, an engine that was chosen or that has a budget may be replaced by cheaper ones while it runs.
    """
    if args.remeasure:
        forget()
    choice, engine, budget_ms = None, args.engine, args.budget_ms
    if engine == "auto" and not args.model and (live or budget_ms):
        choice = choose(budget_ms or DEFAULT_MS, profile, say=say)
        engine, budget_ms = choice.engine, choice.budget_ms
    ego = EgoFilter(
        profile,
        engine=engine,
        budget_ms=budget_ms if live else None,
        model=args.model,
        barge_in=BargeInSettings(args.threshold, confirm_s=args.confirm_s, ask_db=args.ask_db),
        learn=make_learner(args, live, profile),
        output=args.sound,
    )
    if choice:
        ego.engine_reason = choice.reason
    if profile is None and ego.engine_name in HAVE_LINEAR_STAGE:
        say(
            "no profile: the robot is not calibrated, loudspeaker and room are learned from its first seconds"
            " ('edgefilter calibrate' measures them beforehand)"
        )
    return ego, choice


def make_learner(args: argparse.Namespace, live: bool, profile: Profile | None) -> Learner | None:
    """A learner in another process for a live run, in this one for a recording; none where it would take the filter's core."""
    if args.no_learn:
        return None
    remember = Path(args.learn) if args.learn else None
    if not live:
        from edgefilter.learning.path_learner import PathLearner

        return PathLearner(profile, remember)
    if len(allowed_cores()) == 1:
        say("one core only: loudspeaker and room are not learned while running")
        return None
    return BackgroundLearner(profile, remember)


def check_request(args: argparse.Namespace, ego: EgoFilter, source: Source) -> None:
    """Raise UsageError for what was asked of a filter that cannot do it, SignalError for a profile of other microphones."""
    names = ", ".join(HAVE_LINEAR_STAGE)
    if ego.profile and ego.profile.microphones != source.microphones:
        raise SignalError(
            f"the profile holds {ego.profile.microphones} microphones, found {source.microphones}: name those that were"
            " calibrated with --mic-channels, or calibrate again with these"
        )
    if args.turns and not ego.judges_speech:
        raise UsageError(f"--turns needs an engine that detects speech, and {ego.engine_name} does not: take crnn")
    if ego.waits_for_end and source.live:
        raise UsageError(
            f"engine {ego.engine_name} needs the whole recording before it answers: give --input FILE or take another"
            " engine"
        )
    if args.save_profile and not ego.can_adapt:
        needed = f"give --profile and an engine with a linear stage ({names})"
        raise UsageError(f"--save-profile writes back an adapted path: {needed}")
    if args.learn and ego.stats()["linear_stage"] is None:
        raise UsageError(
            f"--learn keeps what a linear stage has learned, which {ego.engine_name} lacks: take one of {names}"
        )


def _write_results(
    args: argparse.Namespace, ego: EgoFilter, observers: Observers, report: RunReport, figures: dict[str, object]
) -> None:
    """Write all that was asked for; raises the first reason why the run failed or something could not be written."""
    failure = report.failure
    for write, wanted in (
        (lambda: write_json(figures, args.json), args.json),
        (lambda: save_profile(ego, args.save_profile), args.save_profile),
        (partial(observers.finish, figures), True),
        (ego.close, True),
    ):
        try:
            if wanted:
                write()
        except EdgefilterError as error:  # what else there is to write is still written
            failure = failure or error
    if failure:
        raise failure


def save_profile(ego: EgoFilter, path: str) -> None:
    """Write the adapted profile and say which effects have become part of its path."""
    adapted = ego.adapted_profile()
    adapted.save(path)
    left = {name for name, _ in adapted.echo.effects}
    before = ego.profile.echo.effects if ego.profile else ()
    held = ", ".join(name for name, _ in before if name not in left)
    say(f"the adapted path is in {path}" + (f"; {held} is part of it now and no longer listed" if held else ""))


def _say_end(args: argparse.Namespace, report: RunReport, missed: str) -> None:
    seconds = report.samples_in / SAMPLE_RATE
    factor = f", {report.process_s / seconds:.3f} of real time" if seconds else ""
    how = "stopped after" if report.interrupted else "filtered"
    say(
        f"{how} {seconds:.1f} s in {report.wall_s:.1f} s{factor}; {report.samples_out} samples to {args.output},"
        f" {report.lost} lost{missed}"
    )
    if report.verdict:
        for line in verdict_lines(report.verdict):
            say(line)


def verdict_lines(verdict: Verdict) -> list[str]:
    """How much of the robot was removed, at which lag, how often a human was noticed, and what was wrong, a line each."""
    told = []
    if verdict.removed_db is not None:
        lag = verdict.lag_ms
        after = "" if lag is None else f", heard {abs(lag):.0f} ms {'before' if lag < -0.5 else 'after'} the reference"
        told.append(f"while it talked alone, the robot was lowered by {verdict.removed_db:.1f} dB{after}")
    if verdict.noticed is not None:
        times = "never" if not verdict.noticed else "once" if verdict.noticed == 1 else f"{verdict.noticed} times"
        told.append(f"a human was noticed {times}")
    return [*(["; ".join(told)] if told else []), *(f"wrong: {why}" for why in verdict.wrong)]


@contextmanager
def garbage_of_this_run_only() -> Iterator[None]:
    """Keep the garbage collector from what was there before: looking through all modules takes 13 to 20 ms, more than a hop lasts."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
