"""Folders of speech: those with a transcripts.tsv, and LibriSpeech's speaker/chapter folders."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import soundfile as sf
from scipy import signal

from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, Samples

ENDINGS = {".flac", ".wav", ".ogg"}
SHORTEST_S = 1.0
ENOUGH_S = 20.0
"""Seconds of a speaker from which on more change nothing; below, the weight falls with their square: who says three words
says them again and again."""


@dataclass(frozen=True)
class Corpus:
    """Paths of the utterances of each speaker, and how many seconds each has, as far as that is known."""

    speakers: dict[str, tuple[Path, ...]]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of utterances."""
        return sum(map(len, self.speakers.values()))

    def draw_speaker(self, rng: np.random.Generator) -> str:
        """Any speaker, however many utterances there are of each; those with less than ENOUGH_S more seldom."""
        names = sorted(self.speakers)
        weights = np.array([min(1.0, self.seconds.get(name, ENOUGH_S) / ENOUGH_S) ** 2 for name in names])
        return str(rng.choice(names, p=weights / weights.sum()))

    def draw(
        self, rng: np.random.Generator, speaker: str, seconds: float, said: list[Path] | None = None, rate: int = 100
    ) -> Samples:
        """Utterances of that speaker, 0.1 to 0.5 s apart, cut at `seconds`; (n,), peak 0.5.

        said: gets their paths. rate: at which they are played, percent; pitch and formants go with it, so that it is another
        voice.
        """
        parts: list[Samples] = []
        wanted, have = round(seconds * SAMPLE_RATE), 0
        while have < wanted:
            path = self.speakers[speaker][int(rng.integers(len(self.speakers[speaker])))]
            part = read_speech(path)
            if rate != 100:
                part = signal.resample_poly(part, 100, rate).astype(np.float32)
            if said is not None:
                said.append(path)
            pause = np.zeros(int(rng.uniform(0.1, 0.5) * SAMPLE_RATE), np.float32)
            parts += [part, pause]
            have += part.size + pause.size
        speech = np.concatenate(parts)[:wanted]
        return 0.5 / max(float(np.abs(speech).max()), 1e-6) * speech


def read_corpus(*folders: Path) -> Corpus:
    """All utterances below these folders by speaker.

    The speaker comes from transcripts.tsv (path, speaker, seconds, text; no header) where there is one, else from
    LibriSpeech's names, speaker-chapter-number.flac. Raises UsageError where no speech is found.
    """
    speakers: dict[str, list[Path]] = {}
    seconds: dict[str, float] = {}
    for folder in folders:
        table = folder / "transcripts.tsv"
        if table.is_file():
            with table.open(encoding="utf-8", newline="") as lines:
                rows = [row for row in csv.reader(lines, delimiter="\t", quoting=csv.QUOTE_NONE) if len(row) >= 3]
            rows = [row for row in rows if row[2] != "seconds" and float(row[2]) >= SHORTEST_S]
            found = [(folder / row[0], row[1]) for row in rows]
            for _, speaker, length, *_ in rows:
                seconds[speaker] = seconds.get(speaker, 0.0) + float(length)
        else:
            found = [(path, path.stem.split("-")[0]) for path in sorted(folder.rglob("*")) if path.suffix in ENDINGS]
        if not found:
            raise UsageError(
                f"{folder} holds no speech: expected transcripts.tsv beside its files, or LibriSpeech's speaker/chapter"
                " folders"
            )
        for path, speaker in found:
            speakers.setdefault(speaker, []).append(path)
    return Corpus({speaker: tuple(paths) for speaker, paths in speakers.items()}, seconds)


def read_speech(path: Path) -> Samples:
    """The utterance (n,) without the silence around it; raises UsageError for another rate or several channels."""
    samples, rate = sf.read(path, dtype="float32")
    if rate != SAMPLE_RATE or samples.ndim != 1:
        raise UsageError(
            f"{path} has {rate} Hz and shape {samples.shape}, expected {SAMPLE_RATE} Hz mono: convert the corpus first"
        )
    loud = np.flatnonzero(np.abs(samples) > 0.02 * np.abs(samples).max())
    return samples[loud[0] : loud[-1] + 1] if loud.size else samples
