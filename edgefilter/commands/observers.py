"""Who is told of a run while it goes: reactions to the human, logs, the record in a folder, and the display."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import TextIO

from edgefilter.audio.files import make_folder, write_file
from edgefilter.audio.protocols import Source
from edgefilter.audio.recorder import Recorder
from edgefilter.audio.speech import SpokenReference
from edgefilter.commands.barge_in import Availability, BargeInCommand, Lowering
from edgefilter.commands.display import display, interject, say_event, write_json
from edgefilter.errors import AudioFileError, EdgefilterError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.profile.data import Profile
from edgefilter.session import Progress
from edgefilter.types import SAMPLE_RATE, Event

ENDED = (
    *("samples_in", "samples_out", "samples_lost", "interrupted", "failure"),
    *("alignment", "learning", "deadline"),
)
"""Figures of the run that the last line of a log holds."""


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


class Observers:
    """Tells all of them of each block and each event, those who react first; a context manager around the run.

    notes: what the user was told before the run. record: where the sound is to be kept, if anywhere.
    """

    def __init__(
        self,
        args: argparse.Namespace,
        ego: EgoFilter,
        source: Source,
        speech: SpokenReference | None,
        notes: list[str],
    ) -> None:
        self._args, self._ego, self._source, self._speech, self._notes = args, ego, source, speech, notes
        self._stack = ExitStack()
        self._of_events: list[Callable[[Event], None]] = []
        self._of_blocks: list[Callable[[Progress], None]] = []
        self._logs: list[EventLog] = []
        self.record: Record | None = None
        self._turns: TurnWriter | None = None

    def __enter__(self) -> Observers:
        args = self._args
        with ExitStack() as stack:
            if args.barge_in and self._speech:
                self._of_events.append(Lowering(self._speech, args.barge_in).hear)
            if args.on_barge_in:
                self._of_events.append(stack.enter_context(BargeInCommand(args.on_barge_in, interject)).hear)
            if args.barge_in or args.on_barge_in:
                self._of_blocks.append(Availability(self._ego, interject).show)
            if args.record:
                self.record = Record(args.record, self._ego.profile, self._source.microphones)
                stack.enter_context(self.record)
                self._logs.append(self.record.log)
            if args.turns:
                self._turns = TurnWriter(args.turns)
                self._of_events.append(self._turns.hear)
            if args.log_json:
                self._logs.append(EventLog(args.log_json))
            self._of_blocks.append(stack.enter_context(display(self._source, self._ego, args.quiet)))
            self._stack = stack.pop_all()
        latency_ms = self._ego.stats()["latency_ms"]
        for log in self._logs:
            log.write("started", 0, engine=self._ego.engine_name, latency_ms=latency_ms, notes=self._notes)
            self._of_events.append(log.hear)
        self._of_events.append(partial(say_event, live=self._source.live))
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def hear(self, event: Event) -> None:
        """An event of the filter, of the source or of the sink."""
        for hear in self._of_events:
            hear(event)

    def show(self, progress: Progress) -> None:
        """A block has been filtered."""
        for show in self._of_blocks:
            show(progress)

    def finish(self, figures: dict[str, object]) -> None:
        """Write what only the end knows; raises the first reason why something of it, or before, could not be written."""
        failure: EdgefilterError | None = None
        for log in self._logs:
            log.write("ended", int(str(figures["samples_in"])), **{name: figures[name] for name in ENDED})
            log.close()
            failure = failure or log.failure
        if self._turns:
            failure = failure or self._turns.failure
        if self.record:
            self.record.finish(figures)
        if failure:
            raise failure
