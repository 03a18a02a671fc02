"""Who is told of a run while it goes: reactions to the human, logs, the record in a folder, and the display."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Container, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import TextIO

from edgefilter.audio import pulse
from edgefilter.audio.files import Recorder, make_folder, write_file
from edgefilter.audio.port import SpokenReference
from edgefilter.audio.protocols import Source
from edgefilter.commands.display import display, interject, say_event, write_json
from edgefilter.errors import AudioFileError, EdgefilterError
from edgefilter.filter.barge_in import INTERRUPTIONS, SUSPICIONS
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.profile.data import Profile
from edgefilter.session import Progress
from edgefilter.types import SAMPLE_RATE, Event, EventKind

ENDED = ("samples_in", "samples_out", "samples_lost", "interrupted", "failure", "alignment", "learning", "deadline")
"""Figures of the run that the last line of a log holds."""
LOWERED = {"stop": 0.0, "duck": 10 ** (-10 / 20)}
"""Gain of the robot's speech while the human speaks, by the word of --barge-in."""
SERVER_S = 0.1
"""Seconds until what is lowered in the sound server stands in the reference: 0.055 to 0.095 s after the event in eight trials with both
cores busy, PulseAudio and PipeWire."""
FOREVER_S = 3600.0
"""Longer than any time in which a lowered voice would have to be heard, seconds."""
PATIENCE_S = 2.0
"""How long a command may still run when the run has ended."""
MOST_AT_ONCE = 8
"""Commands that may run at the same time: those that never end must not fill the machine."""


class EventLog:
    """Writes events to a file, or with '-' to standard output; each line is flushed, so that it survives a crash.

    A line has time (seconds of the microphone), at (UTC), kind, and detail or figures. A file that takes no more, or a
    reader that has gone, ends the log and not the run; why stands in `failure`. Raises AudioFileError where the file
    cannot be opened.
    """

    def __init__(self, path: str | Path) -> None:
        self.failure: AudioFileError | None = None
        self._path = path
        try:
            self._file: TextIO = sys.stdout if path == "-" else open(path, "w", encoding="utf-8")  # noqa: SIM115
        except OSError as error:
            raise AudioFileError(
                f"log {path} cannot be written: {error.strerror}; name a file in a folder that exists"
            ) from None

    def close(self) -> None:
        """End it; lines are on the disk already, and what could not be flushed was reported when it was written."""
        if self._path != "-":
            with suppress(OSError):
                self._file.close()

    def hear(self, event: Event) -> None:
        """Write an event."""
        self.write(event.kind, event.sample, detail=event.detail)

    def write(self, kind: str, sample: int, **more: object) -> None:
        """Write a line of any kind, as of this sample of the microphone."""
        if self.failure:
            return
        at = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        line = {"time": round(sample / SAMPLE_RATE, 3), "at": at, "kind": kind, **more}
        try:
            self._file.write(json.dumps(line, allow_nan=False, default=float) + "\n")
            self._file.flush()
        except OSError as error:
            self.failure = AudioFileError(f"log {self._path} takes no more lines: {os.strerror(error.errno or 0)}")


class Record(Recorder):
    """Everything of a run in one folder, so that it can be repeated and diagnosed.

    The sound, events.jsonl, run.json with the figures, and profile.npz if the run had a profile to begin with.
    """

    def __init__(self, folder: str | Path, profile: Profile | None, microphones: int) -> None:
        super().__init__(folder, microphones)
        self.log = EventLog(self.folder / "events.jsonl")
        if profile is not None:
            profile.save(self.folder / "profile.npz")

    def finish(self, figures: dict[str, object]) -> None:
        """Write the figures; raises where they, or the sound before them, could not be written."""
        write_json(figures, str(self.folder / "run.json"))
        if self.failure:
            raise self.failure


class TurnWriter:
    """Writes each finished turn of the human to a WAV file of its own: FOLDER/turn_0001.wav, turn_0002.wav, ...

    A file that cannot be written ends the writing and not the run; why stands in `failure`. Raises AudioFileError where
    the folder cannot be made.
    """

    def __init__(self, folder: str | Path) -> None:
        self.failure: AudioFileError | None = None
        self.written = 0
        self._folder = Path(folder)
        make_folder(self._folder, "the turns")

    def hear(self, event: Event) -> None:
        """Write the turn that an event brings, if it brings one."""
        if event.turn is None or self.failure:
            return
        try:
            write_file(self._folder / f"turn_{self.written + 1:04d}.wav", event.turn.samples)
        except AudioFileError as error:
            self.failure = error
        else:
            self.written += 1


class EventCommand:
    """Runs a shell command at each event of some kinds, in a thread of its own, so that the sound does not wait for it.

    The command finds what happened in EDGEFILTER_EVENT, EDGEFILTER_TIME (seconds of the microphone) and
    EDGEFILTER_DETAIL. What it prints goes to standard error. Whatever goes wrong is one line, given to say, that
    begins with the option.
    """

    def __init__(self, option: str, kinds: Container[EventKind], command: str, say: Callable[[str], None]) -> None:
        self._option, self._kinds, self._command, self._say = option, kinds, command, say
        self._threads: list[threading.Thread] = []
        self._running: set[subprocess.Popen[bytes]] = set()

    def __enter__(self) -> EventCommand:
        return self

    def hear(self, event: Event) -> None:
        """Start the command if the event is of those kinds."""
        if event.kind not in self._kinds:
            return
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        if len(self._threads) >= MOST_AT_ONCE:
            self._complain(f"not run, {MOST_AT_ONCE} earlier ones have not ended")
            return
        thread = threading.Thread(target=self._run, args=(event,), daemon=True)
        try:
            thread.start()
        except RuntimeError as error:  # the system has no thread left
            self._complain(f"cannot be run ({error})")
        else:
            self._threads.append(thread)

    def _run(self, event: Event) -> None:
        told = {"EVENT": event.kind, "TIME": f"{event.sample / SAMPLE_RATE:.3f}", "DETAIL": event.detail}
        environment = {**os.environ, **{f"EDGEFILTER_{name}": value for name, value in told.items()}}
        try:
            process = subprocess.Popen(
                self._command, shell=True, stdin=subprocess.DEVNULL, stdout=2, env=environment, start_new_session=True
            )
        except (OSError, ValueError) as error:
            self._complain(f"cannot be run ({error})")
            return
        self._running.add(process)
        code = process.wait()
        self._running.discard(process)
        if code:
            self._complain(f"ended with {code}")

    def _complain(self, what: str) -> None:
        self._say(f"{self._option}: {what}: {self._command}")

    def __exit__(self, *exc: object) -> None:
        """Wait a little for the commands that still run, then end them."""
        until = time.monotonic() + PATIENCE_S
        for thread in self._threads:
            thread.join(max(until - time.monotonic(), 0.0))
        for process in list(self._running):
            self._complain(f"killed, since it ran {PATIENCE_S:.0f} s longer than the filter")
            if hasattr(os, "killpg"):  # the shell's children, too; start_new_session made it the first of its group
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()


class Lowering:
    """Ends or lowers what the robot says while the human speaks (a word of LOWERED says which), and lowers it when the filter asks.

    fade: lets the robot go on with a gain.
    """

    def __init__(self, fade: Callable[[float], None], ego: EgoFilter, how: str | None) -> None:
        self._fade, self._ego, self._how = fade, ego, how
        self._gain = self._now = 1.0

    def hear(self, event: Event) -> None:
        """Follow an event."""
        if self._how and event.kind in INTERRUPTIONS:
            self._gain = LOWERED[self._how]
        elif self._how == "duck" and event.kind == "speech_stopped":
            self._gain = 1.0
        before, self._now = self._now, min(self._gain, self._ego.voice_gain)
        if self._now != before:
            self._fade(self._now)


def never_ask(ego: EgoFilter, reason: str) -> None:
    """Let the filter ask no longer, since the robot cannot lower its voice, and tell the user why."""
    ego.queued_s = FOREVER_S
    interject(f"the robot is not asked to lower its voice: {reason}")


class Availability:
    """Says, each time it begins, that the engine at work tells no speech probability, so that no human is noticed."""

    def __init__(self, ego: EgoFilter, say: Callable[[str], None]) -> None:
        self._ego, self._say, self._there = ego, say, True

    def show(self, block: Progress) -> None:
        """Look after a block."""
        there = self._ego.speech_probability is not None or block.samples < self._ego.hop
        if self._there and not there:
            self._say(
                f"barge-in is unavailable: engine {self._ego.engine_name} does not tell whether somebody speaks; take"
                " another with --engine"
            )
        self._there = there


@dataclass
class Observers:
    """Tells all of them of each block and each event, those who react first; record: where the sound is kept, if anywhere."""

    of_events: list[Callable[[Event], None]] = field(default_factory=list)
    of_blocks: list[Callable[[Progress], None]] = field(default_factory=list)
    logs: list[EventLog] = field(default_factory=list)
    record: Record | None = None
    turns: TurnWriter | None = None

    def hear(self, event: Event) -> None:
        """An event of the filter, of the source or of the sink."""
        for hear in self.of_events:
            hear(event)

    def show(self, progress: Progress) -> None:
        """A block has been filtered."""
        for show in self.of_blocks:
            show(progress)

    def finish(self, figures: dict[str, object]) -> None:
        """Write what only the end knows; raises the first reason why something of it, or before, could not be written."""
        failure: EdgefilterError | None = None
        for log in self.logs:
            log.write("ended", int(str(figures["samples_in"])), **{name: figures[name] for name in ENDED})
            log.close()
            failure = failure or log.failure
        if self.turns:
            failure = failure or self.turns.failure
        if self.record:
            self.record.finish(figures)
        if failure:
            raise failure


@contextmanager
def observing(
    args: argparse.Namespace, ego: EgoFilter, source: Source, speech: SpokenReference | None, notes: list[str]
) -> Iterator[Observers]:
    """All who are told of the run that the arguments ask for; notes: what the user was told before it."""
    told = Observers()
    with ExitStack() as stack:
        if speech and (args.barge_in or args.ask_db):
            told.of_events.append(Lowering(speech.fade, ego, args.barge_in).hear)
        elif args.ask_db:
            programs = stack.enter_context(pulse.Programs(source.monitored, partial(never_ask, ego)))
            ego.queued_s = SERVER_S
            told.of_events.append(Lowering(programs.fade, ego, None).hear)
        commands = ("--on-barge-in", INTERRUPTIONS, args.on_barge_in), ("--on-suspicion", SUSPICIONS, args.on_suspicion)
        for option, kinds, command in commands:
            if command:
                told.of_events.append(stack.enter_context(EventCommand(option, kinds, command, interject)).hear)
        if args.barge_in or args.on_barge_in or args.on_suspicion:
            told.of_blocks.append(Availability(ego, interject).show)
        if args.record:
            told.record = Record(args.record, ego.profile, source.microphones)
            stack.enter_context(told.record)
            told.logs.append(told.record.log)
        if args.turns:
            told.turns = TurnWriter(args.turns)
            told.of_events.append(told.turns.hear)
        if args.log_json:
            told.logs.append(EventLog(args.log_json))
        told.of_blocks.append(stack.enter_context(display(source, ego, args.quiet)))
        for log in told.logs:
            log.write("started", 0, engine=ego.engine_name, latency_ms=ego.stats()["latency_ms"], notes=notes)
            told.of_events.append(log.hear)
        told.of_events.append(partial(say_event, live=source.live))
        yield told
