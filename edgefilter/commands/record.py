"""`edgefilter run --record`: everything of a run in one folder, so that it can be repeated and diagnosed."""

from __future__ import annotations

from pathlib import Path

from edgefilter.audio.recorder import Recorder
from edgefilter.commands.display import write_json
from edgefilter.commands.event_log import EventLog
from edgefilter.profile.data import Profile


class Record(Recorder):
    """The sound, events.jsonl, run.json with the figures, and profile.npz if the run had a profile to begin with."""

    def __init__(self, folder: str | Path, profile: Profile | None) -> None:
        super().__init__(folder)
        self.log = EventLog(self.folder / "events.jsonl")
        if profile is not None:
            profile.save(self.folder / "profile.npz")

    def finish(self, figures: dict[str, object]) -> None:
        """Write the figures; raises where they, or the sound before them, could not be written."""
        write_json(figures, str(self.folder / "run.json"))
        if self.failure:
            raise self.failure
