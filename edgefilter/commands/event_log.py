"""What happened, one JSON line an event, for programs that watch a run."""

from __future__ import annotations

import json
import os
import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import TextIO

from edgefilter.errors import AudioFileError
from edgefilter.types import SAMPLE_RATE, Event


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
        """End it; lines are on the disk already."""
        if self._path != "-":
            try:
                self._file.close()
            except OSError:  # what could not be flushed was reported when it was written
                pass

    def hear(self, event: Event) -> None:
        """Write an event of the filter or of the two ends."""
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
