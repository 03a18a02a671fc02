"""How far the linear stage's error stands above what robot and room leave there, as learned while running."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.stft import StftConfig
from edgefilter.types import SAMPLE_RATE, Samples, Spectrum

BANDS, BAND_HZ = 29, (180.0, 6200.0)
"""Bands, geometric where they are wider than a bin."""
ECHO_DECAY_S = 0.056
"""Fall of the echo's expected rest by a factor e: the tail beyond the canceller's."""
ELSEWHERE = 0.1
"""Part of the echo's mean over all bands that counts in each: distortion falls on other frequencies than it comes
from."""
FIRST_GAIN = 0.05
"""Part of the echo's power that is taken to stay before anything was learned, -13 dB; it is never taken to be more than
all."""
FIRST_SPREAD, LEAST_SPREAD = 1.2, 0.7
"""Standard deviation of the log ratio of powers at first, and the least; a single bin of noise has 1.28."""
MEAN_TO_SPREAD = 1.25
"""Standard deviation of a Gaussian over its mean absolute value."""
LEARN_S, LEARN_FIRST_S = 6.0, 0.32
"""Memory of what is learned, seconds of robot; it begins with the latter and grows."""
LEARN_EVERY = 2
"""Hops between two lessons: what changes over seconds need not be followed in each."""
RISE, FALL = 1.0, 2.0
"""Clip of the log ratio that is learned from, upwards and downwards: a human lifts what is expected by little."""
SMOOTHING_S = 0.045
FLOOR_S, FLOOR_PARTS, FLOOR_BIAS = 1.0, 4, np.float32(2.0)
"""Noise is the least of the smoothed power over so long, found in so many parts, times the bias of a least
(minimum statistics, Martin 2001, with a fixed bias)."""
CLIP = (-1.0, 3.0)
"""Bounds on one band's excess, so that no band decides alone."""
SILENCE = 1e-9
"""Power of a bin that nothing falls below."""


class Excess:
    """Compares the error of one stream, band by band, with the echo's rest and the noise that are to be expected.

    The part of the echo that stays, and how much it varies, is learned per band from the robot itself; no profile is
    needed, and what a human adds is too short and too clipped to lift it. A human is not the only thing that exceeds:
    so does a click. echo_share: which part of what was expected in the last frame is the robot's, mean over the bands,
    0 to 1.

    >>> from edgefilter.dsp.stft import StftConfig
    >>> stft = StftConfig()
    >>> quiet, loud = np.full(stft.bins, 1e-2, np.complex64), np.full(stft.bins, 1.0, np.complex64)
    >>> excess = Excess(stft)
    >>> steady = [excess.step(0 * quiet, quiet) for _ in range(100)][-1]
    >>> steady < 0 < 2 < excess.step(0 * quiet, loud)
    True
    """

    def __init__(self, stft: StftConfig) -> None:
        low, high = (round(hz / stft.frequencies[1]) for hz in BAND_HZ)
        edges = np.unique(np.round(np.geomspace(max(low, 1), min(high, stft.bins), BANDS + 1)).astype(int))
        self._bins, width = slice(edges[0], edges[-1]), edges[-1] - edges[0]
        starts = edges[:-1] - edges[0]
        self._starts = 2 * np.concatenate((starts, starts + width))
        self._spectra = np.zeros((2, width), np.complex64)
        self._squares = np.zeros(4 * width, np.float32)
        hop_s = stft.hop / SAMPLE_RATE
        self._lesson_s = LEARN_EVERY * hop_s
        self._decay = np.float32(np.exp(-hop_s / ECHO_DECAY_S))
        self._follow = np.float32(1.0 - np.exp(-hop_s / SMOOTHING_S))
        self._part = max(1, round(FLOOR_S / FLOOR_PARTS / hop_s))
        bands = starts.size
        self._elsewhere = np.float32(ELSEWHERE / bands)
        self._log_gain = np.full(bands, np.log(FIRST_GAIN), np.float32)
        self._spread = np.full(bands, FIRST_SPREAD, np.float32)
        self._echo, self._smooth = np.zeros(bands, np.float32), np.zeros(bands, np.float32)
        self._floors = np.full((FLOOR_PARTS, bands), np.inf, np.float32)
        self._least, self._past_least = np.full((2, bands), np.inf, np.float32)
        self._steps, self._heard_s = 0, LEARN_FIRST_S
        self.echo_share = 0.0

    def step(self, echo: Spectrum, error: Spectrum, learn: bool = True) -> float:
        """Mean excess of a frame over all bands, in standard deviations: about 0 for robot and room alone.

        echo, error: (bins,) complex64 of the frame. learn: whether what is in the error may be the rest of that echo.
        """
        found, brought = self._powers(error, echo)
        floor = self._floor(found)
        self._echo *= self._decay
        np.maximum(self._echo, brought, out=self._echo)
        rest = np.exp(self._log_gain)
        rest *= self._echo + self._elsewhere * np.add.reduce(self._echo)
        expected = rest + floor
        ratio = np.log(found / expected)
        excess = ratio / self._spread
        np.maximum(excess, CLIP[0], out=excess)
        np.minimum(excess, CLIP[1], out=excess)
        rest /= expected
        self.echo_share = float(np.add.reduce(rest)) / rest.size
        if learn and self._steps % LEARN_EVERY == 0:
            self._learn(ratio, rest)
        return float(np.add.reduce(excess)) / excess.size

    def _powers(self, error: Spectrum, echo: Spectrum) -> tuple[Samples, Samples]:
        """(bands,) of either; parts squared and summed in one go, which costs half of doing it by steps."""
        self._spectra[0], self._spectra[1] = error[self._bins], echo[self._bins]
        parts = self._spectra.view(np.float32).reshape(-1)
        np.multiply(parts, parts, out=self._squares)
        powers = np.add.reduceat(self._squares, self._starts)
        powers += SILENCE
        return powers[: powers.size // 2], powers[powers.size // 2 :]

    def _floor(self, found: Samples) -> Samples:
        """(bands,) of noise: the least of the smoothed power over FLOOR_S, times its bias."""
        found = self._follow * (found - self._smooth) if self._steps else found
        self._smooth += found
        if self._steps % self._part == 0:
            self._floors[self._steps // self._part % FLOOR_PARTS] = self._least
            self._past_least = np.minimum.reduce(self._floors, axis=0) * FLOOR_BIAS
            self._least[:] = self._smooth
        self._steps += 1
        np.minimum(self._least, self._smooth, out=self._least)
        return np.minimum(self._past_least, FLOOR_BIAS * self._least)

    def _learn(self, ratio: Samples, share: Samples) -> None:
        """Follow gain and spread from the log ratio and the echo's share of what was expected, (bands,); overwrites both."""
        self._heard_s = min(self._heard_s + self.echo_share * self._lesson_s, LEARN_S)
        step = self._lesson_s / self._heard_s
        np.maximum(ratio, -FALL, out=ratio)
        np.minimum(ratio, RISE, out=ratio)
        share *= step
        share *= ratio
        self._log_gain += share
        np.minimum(self._log_gain, 0.0, out=self._log_gain)
        np.abs(ratio, out=ratio)
        ratio *= step * MEAN_TO_SPREAD
        self._spread *= 1.0 - step
        self._spread += ratio
        np.maximum(self._spread, LEAST_SPREAD, out=self._spread)
