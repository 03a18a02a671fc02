"""What conversations are made of: speech, rooms, recorded noises, measured responses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import soundfile as sf

from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, Samples
from export.corpus import ENDINGS, Corpus
from export.rooms import Room

RESPONSES = ("room", "loudspeaker", "microphone")
"""Folders of measured impulse responses."""


@dataclass(frozen=True)
class Material:
    """What conversations are made of.

    noises: recordings (n,) float32. responses: measured impulse responses (n,) by RESPONSES. Either may be empty.
    """

    humans: Corpus
    robots: Corpus
    rooms: list[Room]
    noises: tuple[Samples, ...] = ()
    responses: dict[str, tuple[Samples, ...]] = field(default_factory=dict)

    def room(self, rng: np.random.Generator, kind: str) -> Room:
        """One of that kind, else any."""
        rooms = [room for room in self.rooms if room.kind == kind] or self.rooms
        return rooms[int(rng.integers(len(rooms)))]

    def response(self, rng: np.random.Generator, kind: str) -> Samples | None:
        """A measured response of that kind, its largest sample 1, from its direct sound on; None where there are none."""
        known = self.responses.get(kind, ())
        return known[int(rng.integers(len(known)))] if known else None

    def noise(self, rng: np.random.Generator, samples: int) -> Samples | None:
        """A stretch (samples,) of one of the noises, repeated where it is shorter; None where there are none."""
        if not self.noises:
            return None
        noise = self.noises[int(rng.integers(len(self.noises)))]
        return np.take(noise, np.arange(samples) + int(rng.integers(noise.size)), mode="wrap")


def read_noises(*folders: Path) -> tuple[Samples, ...]:
    """All recordings in these folders and those below; raises UsageError where all of them together hold none."""
    return tuple(_read(path) for folder in folders for path in _sounds(folder, "noise"))


def read_responses(*folders: Path) -> dict[str, tuple[Samples, ...]]:
    """Impulse responses by the folder (room, loudspeaker, microphone) that they lie in; raises UsageError where there are none."""
    found: dict[str, list[Samples]] = {}
    for folder in folders:
        for path in _sounds(folder, "impulse response"):
            if path.parent.name in RESPONSES:
                response = _read(path)
                direct = int(np.argmax(np.abs(response)))
                cut = response[max(0, direct - 16) :][:SAMPLE_RATE] / max(float(np.abs(response).max()), 1e-9)
                found.setdefault(path.parent.name, []).append(cut)
    return {kind: tuple(each) for kind, each in found.items()}


def _sounds(folder: Path, what: str) -> list[Path]:
    paths = sorted(path for path in folder.rglob("*") if path.suffix in ENDINGS)
    if not paths:
        raise UsageError(f"{folder} holds no {what}: expected {', '.join(sorted(ENDINGS))} files below it")
    return paths


def _read(path: Path) -> Samples:
    samples, rate = sf.read(path, dtype="float32")
    if rate != SAMPLE_RATE or samples.ndim != 1:
        raise UsageError(f"{path} has {rate} Hz and shape {samples.shape}, expected {SAMPLE_RATE} Hz mono: convert it")
    return samples
