"""Who says what and when."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import signal

from edgefilter.types import SAMPLE_RATE, Samples
from export.corpus import Corpus
from export.simulate.recipe import Recipe

RATES = (82, 122)
"""Percent of its own speed at which a voice is played to be another: from a low man's to a high woman's is about as much."""
RISES_S = (0.05, 0.3)
"""Within which a soft utterance has risen from nothing: a consonant to a syllable."""


@dataclass(frozen=True, eq=False)
class Part:
    """The robot's: told to the player (n,), played by it (n,) with lag and volume, and the utterances' [start, end] in told."""

    told: Samples
    played: Samples
    utterances: tuple[tuple[int, int], ...]


def robot(rng: np.random.Generator, recipe: Recipe, voices: Corpus, samples: int, moving: bool) -> Part:
    """Utterance after utterance, each 2 to 7 s; moving: with a lag and a volume of its own."""
    voice, played_at = voices.draw_speaker(rng), rate(rng, recipe)
    told, played = np.zeros((2, samples), np.float32)
    utterances: list[tuple[int, int]] = []
    lag = int(rng.uniform(0.0, 0.3) * SAMPLE_RATE)
    at = int(rng.uniform(0.0, 0.6) * SAMPLE_RATE) if recipe.seconds > 5 else 0
    volume = 1.0
    while at < samples - SAMPLE_RATE // 2:
        speech = voices.draw(rng, voice, rng.uniform(2.0, 7.0), rate=played_at)[: samples - at]
        told[at : at + speech.size] = speech
        end = min(samples, at + lag + speech.size)
        played[at + lag : end] += volume * speech[: max(0, end - at - lag)]
        utterances.append((at, at + speech.size))
        new_lag = int(rng.uniform(*recipe.lag_s) * SAMPLE_RATE) if moving else lag
        at += speech.size + int(rng.uniform(0.3, 1.2) * SAMPLE_RATE) + max(0, lag - new_lag)
        volume = 10 ** (rng.uniform(*recipe.volume_db) / 20) if moving else 1.0
        lag = new_lag
    return Part(told, played, tuple(utterances))


@dataclass(frozen=True, eq=False)
class Human:
    """The human at the microphone (n,), who it is and the names of the recordings; no speaker where nobody speaks."""

    clean: Samples
    speaker: str | None = None
    recordings: tuple[str, ...] = ()

    @property
    def about(self) -> dict[str, object]:
        return {"speaker": self.speaker, "recordings": self.recordings}


def human(rng: np.random.Generator, recipe: Recipe, humans: Corpus, response: Samples, samples: int) -> Human:
    """Silent at first, then one or more utterances; now and then nobody speaks."""
    clean = np.zeros(samples, np.float32)
    if rng.random() >= recipe.human:
        return Human(clean)
    said: list[Path] = []
    at = int(rng.uniform(*recipe.silence_s) * SAMPLE_RATE)
    speaker, played_at = humans.draw_speaker(rng), rate(rng, recipe)
    soft = recipe.soft and rng.random() < recipe.soft
    while at < samples - SAMPLE_RATE:
        speech = humans.draw(rng, speaker, rng.uniform(1.5, 7.0), said, played_at)[: samples - at]
        clean[at : at + speech.size] += speech * rise(rng, speech.size) if soft else speech
        at += speech.size + int(rng.uniform(0.5, 3.0) * SAMPLE_RATE)
    heard = signal.oaconvolve(clean, response)[:samples].astype(np.float32)
    return Human(heard, speaker, tuple(sorted({path.name for path in said})))


def rise(rng: np.random.Generator, samples: int) -> Samples:
    """Gain of speech that rises from nothing, (samples,)."""
    return np.minimum(1.0, np.arange(samples, dtype=np.float32) / (rng.uniform(*RISES_S) * SAMPLE_RATE))


def rate(rng: np.random.Generator, recipe: Recipe) -> int:
    """Percent of its own speed at which this one's voice is played."""
    other = recipe.other_voices and rng.random() < recipe.other_voices
    return int(rng.integers(RATES[0], RATES[1] + 1)) if other else 100
