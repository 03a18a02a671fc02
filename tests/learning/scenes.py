"""Robots to learn from: a distorting loudspeaker in a small room, and what may happen to it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import signal

from edgefilter import EgoFilter
from edgefilter.dsp.fractional_delay import interpolate
from edgefilter.types import SAMPLE_RATE, Samples

DELAY = 1200


def voice(seed: int, seconds: float) -> Samples:
    """Noise with the spectrum and the syllables of speech, in utterances of 3 s with pauses."""
    rng = np.random.default_rng(seed)
    n = int(seconds * SAMPLE_RATE)
    sound = signal.lfilter([1], [1, -1.2, 0.5], rng.standard_normal(n))
    syllables = np.repeat(rng.uniform(0.1, 1.0, n // 3200 + 1), 3200)[:n]
    at = np.arange(n) / SAMPLE_RATE
    said = (at % 4.0 < 3.2) & (at > 0.3)
    return (0.05 * sound * signal.lfilter([0.005], [1, -0.995], syllables * said) * 1.5).astype(np.float32)


def room(seed: int, rt60_s: float = 0.25) -> Samples:
    """(3200,) of a path with its direct sound first."""
    rng = np.random.default_rng(seed)
    at = np.arange(3200)
    response = 0.15 * rng.standard_normal(at.size) * 10 ** (-3 * at / (rt60_s * SAMPLE_RATE))
    response[0] = 1.0
    return (0.5 * response).astype(np.float32)


def loudspeaker(x: Samples) -> Samples:
    """A driver whose force falls with the displacement: about -20 dB of distortion."""
    displacement = signal.sosfilt(signal.butter(2, 250, fs=SAMPLE_RATE, output="sos"), x)
    return x - x * 40.0 * displacement**2 / (1.0 + 40.0 * displacement**2) + 1.5 * x * displacement


@dataclass
class Scene:
    """seconds of a robot. human_db: a human's level against the robot's, None for none; repeats: they say what the robot said a second ago.

    volume, moved, lag: what changes in the middle: a factor, another room's seed, samples. ppm: the clocks' difference.
    """

    seconds: float = 12.0
    human_db: float | None = None
    repeats: bool = False
    volume: float = 1.0
    moved: int | None = None
    lag: int = 0
    ppm: float = 0.0
    reference: Samples = field(init=False)
    mic: Samples = field(init=False)
    human: Samples = field(init=False)

    def __post_init__(self) -> None:
        self.reference = x = voice(1, self.seconds)
        n, half = x.size, int(round(self.seconds / 8) * 4 * SAMPLE_RATE)
        later = np.arange(n) >= half
        played = loudspeaker(np.where(later, self.volume * x, x))
        paths = [room(2), room(2 if self.moved is None else self.moved)]
        echo = sum(
            signal.fftconvolve(np.concatenate((np.zeros(DELAY + late, np.float32), played * part)), path)[:n]
            for part, path, late in ((~later, paths[0], 0), (later, paths[1], self.lag))
        )
        if self.ppm:
            echo = interpolate(echo, np.arange(n) * (1 + 1e-6 * self.ppm))
        self.human = np.zeros(n, np.float32)
        if self.human_db is not None:
            self.human = np.roll(x, SAMPLE_RATE) if self.repeats else voice(7, self.seconds + 1.7)[-n:]
            self.human = signal.fftconvolve(self.human, room(11))[:n].astype(np.float32)
            self.human *= 10 ** (self.human_db / 20) * np.std(echo) / np.std(self.human)
        fan = 1e-4 * np.random.default_rng(3).standard_normal(n)
        self.mic = (echo + self.human + fan).astype(np.float32)

    def part(self, start_s: float, stop_s: float) -> Scene:
        """The scene between two moments."""
        span = slice(int(start_s * SAMPLE_RATE), int(stop_s * SAMPLE_RATE))
        self.reference, self.mic, self.human = self.reference[span], self.mic[span], self.human[span]
        return self


def run(scene, learner=None, block=4096, profile=None):
    ego = EgoFilter(profile, engine="linear", learn=learner)
    out = [
        ego.process(scene.mic[at : at + block], scene.reference[at : at + block])
        for at in range(0, scene.mic.size, block)
    ]
    kinds = [event.kind for event in ego.events()]
    return np.concatenate([*out, ego.flush()]), kinds, ego
