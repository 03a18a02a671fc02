"""What is judged: conversations, humans laid on recordings of a real loudspeaker, and pairs of a real device as recorded."""

from __future__ import annotations

import csv
import hashlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import soundfile

from bench.measure.conversation import Conversation
from bench.measure.real_streams import (
    ECHO_ONLY,
    ROBOT_ALONE,
    Cells,
    Laid,
    Recording,
    Signals,
    find_recordings,
    lay,
    looped,
)
from edgefilter.errors import UsageError
from edgefilter.profile.data import Profile
from edgefilter.types import Samples


class NotHere(UsageError):
    """What a system needs and this clip, or this machine, does not have."""


class Real:
    """A recording of a real device, read as a `Conversation` is; without calibration, fan and known lag."""

    profile: Profile | None = None

    def __init__(self, stream: Recording | Laid) -> None:
        self.stream = stream

    @cached_property
    def _signals(self) -> Signals:
        return self.stream.signals()

    @cached_property
    def fingerprint(self) -> str:
        human = [] if self._signals.human is None else [self._signals.human.tobytes()]
        return hashlib.sha256(b"".join([self._signals.mic.tobytes(), self._signals.ref.tobytes(), *human])).hexdigest()

    @property
    def span(self) -> slice:
        return self._signals.span

    def read(self, name: str) -> Samples:
        found = {"mic": self._signals.mic, "ref": self._signals.ref, "clean": self._signals.human}.get(name)
        if found is None:
            raise NotHere(f"recordings of real devices hold no {name}")
        return found

    def delayed_reference(self) -> Samples:
        raise NotHere("the true lag of a real device is not known")


@dataclass(frozen=True)
class Clip:
    """One recording that every system gets.

    set, room: whose table it stands in. speaker, place: the clusters of its intervals. text: what the human says, None
    where nobody knows. voices: other recordings of the same human, for systems that ask for one, each with the span
    in which only they are heard.
    """

    set: str
    room: str
    name: str
    source: Conversation | Recording | Laid
    speaker: str
    place: str
    text: str | None
    voices: tuple[tuple[Path, slice], ...] = ()

    def open(self) -> Conversation | Real:
        """The signals, read when asked for."""
        return self.source if isinstance(self.source, Conversation) else Real(self.source)

    @property
    def talk(self) -> str:
        """Who talks, in the words of the AEC Challenge."""
        return self.source.kind if isinstance(self.source, Recording) else "doubletalk"

    def voice(self) -> Samples:
        """Another recording of the human, (n,); raises NotHere where there is none."""
        if not self.voices:
            raise NotHere("no other recording of this human")
        path, span = self.voices[0]
        return soundfile.read(path, dtype="float32")[0][span]


class Heard:
    """A clip while it is judged: its signals, and what several systems start from, computed once."""

    def __init__(self, clip: Clip) -> None:
        self.clip, self.source = clip, clip.open()
        self.lent_s = 0.0
        self._kept: dict[str, tuple[Samples, float]] = {}

    @property
    def mic(self) -> Samples:
        return self.source.read("mic")

    @property
    def human(self) -> Samples:
        return self.source.read("clean")

    @property
    def has_human(self) -> bool:
        return self.clip.text is not None

    def once(self, name: str, make: Callable[[], Samples]) -> Samples:
        """What make gives, from the second time on without asking it; lent_s grows by what that would have taken."""
        if name in self._kept:
            self.lent_s += self._kept[name][1]
        else:
            began = time.perf_counter()
            made = make()
            self._kept[name] = made, time.perf_counter() - began
        return self._kept[name][0]

    def fan(self) -> Samples:
        """The robot's fan as calibrated, as long as the clip; raises NotHere where it was not recorded."""
        return looped(self.source.read("fan_only"), 0, self.mic.size).astype(np.float32)


@dataclass(frozen=True)
class Laying:
    """How humans of a folder of speech are laid on recordings of a real loudspeaker alone."""

    speech: Path | None = None
    echo_only: str = ROBOT_ALONE
    cells: Cells = Cells(befores=(5.0,))
    cases: int = 8
    seed: int = 0


def find_clips(folders: Sequence[Path], laying: Laying = Laying(), every: int = 1) -> list[Clip]:
    """All clips below the folders, every n-th of each set.

    A folder that holds */meta.json is a set of conversations, one that holds *_lpb.* and *_mic.* files is one of
    recordings. Raises UsageError where nothing is found.
    """
    sets: dict[str, list[Clip]] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UsageError(f"{folder} is no folder, expected conversations or pairs of recordings: check the path")
        for below in [folder, *(path for path in sorted(folder.rglob("*")) if path.is_dir())]:
            found = [*_conversations(below), *_recordings(below, laying)]
            if found:
                name, parent = below.resolve().name, below.resolve().parent.name
                name = name if name not in sets else f"{parent}/{name}"
                sets.setdefault(name, []).extend(replace(clip, set=name) for clip in found)
    clips = [clip for found in sets.values() for clip in found[::every]]
    if not clips:
        raise UsageError(
            f"{', '.join(map(str, folders))}: no */meta.json and no *_lpb and *_mic files, expected conversations (make"
            " some with bench.simulate.conversations) or recordings of a real device"
        )
    return clips


def _conversations(folder: Path) -> Iterator[Clip]:
    found = [Conversation(path.parent) for path in sorted(folder.glob("*/meta.json"))]
    for one in found:
        meta = one.meta
        others = [other for other in found if other is not one and other.meta["speaker"] == meta["speaker"]]
        others = [other for other in others if other.meta["text"] != meta["text"]]
        voices = tuple((other.folder / "clean.flac", other.span) for other in others[:1])
        # every conversation draws a room of its own
        place = f"{folder} {one.folder.name}"
        yield Clip("", meta["room"], one.folder.name, one, str(meta["speaker"]), place, meta["text"], voices)


def _recordings(folder: Path, laying: Laying) -> Iterator[Clip]:
    if not any(path.stem.endswith("_lpb") for path in folder.iterdir() if path.is_file()):
        return
    recordings = find_recordings(folder, laying.echo_only)
    alone = [recording for recording in recordings if recording.kind == ECHO_ONLY]
    for recording in recordings:
        if recording.kind != ECHO_ONLY:
            yield Clip("", f"as recorded, {recording.kind}", recording.name, recording, "", recording.name, None)
    if alone and laying.speech:
        voices = _voices(laying.speech)
        for laid in lay(alone, laying.speech, None, laying.cells, laying.cases, laying.seed):
            speaker = voices[laid.speech][0]
            others = [path for path, (who, _) in voices.items() if who == speaker and path != laid.speech]
            name = f"{laid.name}, {laid.ser:g} dB after {laid.before:g} s"
            other = tuple((path, slice(None)) for path in others[:1])
            yield Clip("", "real loudspeaker", name, laid, speaker, laid.recording.name, laid.text, other)


def _voices(speech: Path) -> dict[Path, tuple[str, str]]:
    """Speaker and text of each recording of a folder of speech."""
    with (speech / "transcripts.tsv").open(encoding="utf-8", newline="") as lines:
        rows = [row for row in csv.reader(lines, delimiter="\t", quoting=csv.QUOTE_NONE) if len(row) == 4]
    return {speech / os.fspath(path): (speaker, text) for path, speaker, _, text in rows}
