"""No echo is subtracted that makes the result louder than the microphone: a limiter on the echo's weight."""

from __future__ import annotations

import math

import numpy as np

from edgefilter.types import SAMPLE_RATE, Samples

MEMORY = 0.8
"""Weight of the past in the smoothed powers per hop of 16 ms; about 80 ms."""
PART = 64
"""Samples, 4 ms, of a hop that are looked at by themselves: a loudspeaker can be cut off in mid-word."""
GROSS = 4.0
"""Power of such a part's error over the microphone's, from which on it is limited whatever the smoothed powers say:
human and robot cancel one another in the microphone by so much in hardly any part."""
NEAR = 0.1
"""Power of a hop's error over the microphone's up to which no part of it is looked at: whatever is too loud there is 10
dB lower."""
ABSENT = 0.1
"""Weight below which the echo is not there at all: so much of a correlation is chance."""
EXCESS = 1.5
"""Error power over microphone power from which on the echo is too loud for a filter that is merely not exact."""
TINY = 1e-20
"""Power of an echo that is none."""
PATIENCE_S = 0.5
"""Seconds after which an echo that is too loud is put down to another path."""


class EchoLimiter:
    """Weighs the echo by gamma = <mic, echo> / <echo, echo>, in 0 to 1, while subtracting all of it would add power.

    hop: samples per step. changed: the path must have become another one; told in one hop each time. heard: gamma over
    about 80 ms.
    """

    def __init__(self, hop: int) -> None:
        self._part = math.gcd(hop, PART)
        self._ramp: Samples = np.arange(1, self._part + 1, dtype=np.float32) / np.float32(self._part)
        self._patience = round(PATIENCE_S * SAMPLE_RATE / hop)
        self._smoothed = 0.0, 0.0, 0.0
        self._weights = np.ones(hop // self._part + 1, np.float32)
        self._limited = False
        self._waited = 0
        self.changed = False

    @property
    def heard(self) -> np.float32:
        """How much of the echo is in the microphone, 0 to 1."""
        return np.float32(_weight(self._smoothed[1] / (self._smoothed[2] + TINY)))

    def measure(self, mic: Samples, echo: Samples) -> bool:
        """Take in a hop (hop,) of both; whether any of the echo is too loud."""
        now = float(mic.dot(mic)), float(mic.dot(echo)), float(echo.dot(echo))
        before, (heard, cross, expected) = self._smoothed, now
        self._smoothed = (
            MEMORY * before[0] + (1.0 - MEMORY) * heard,
            MEMORY * before[1] + (1.0 - MEMORY) * cross,
            MEMORY * before[2] + (1.0 - MEMORY) * expected,
        )
        left = heard - 2.0 * cross + expected
        self._wait(left > EXCESS * heard)
        self._limited = float(self._weights[-1]) < 1.0
        self._weights[0] = self._weights[-1]
        self._weights[1:] = 1.0
        if left <= NEAR * heard:
            return self._limited
        if left > heard and self._smoothed[2] > 2.0 * self._smoothed[1]:
            self._weights[1:] = _weight(cross / expected)
        m, e = mic.reshape(-1, self._part), echo.reshape(-1, self._part)
        heard, cross, expected = (np.einsum("ij,ij->i", a, b) for a, b in ((m, m), (m, e), (e, e)))
        gross = heard - 2.0 * cross + expected > GROSS * heard
        if gross.any():
            self._weights[1:][gross] = np.minimum(self._weights[1:][gross], _weight(cross[gross] / expected[gross]))
        self._limited = bool(self._weights.min() < 1.0)
        return self._limited

    def _wait(self, excessive: bool) -> None:
        """Tell that the path has changed once the echo was too loud for long enough."""
        self._waited = self._waited + 1 if excessive else max(self._waited - 1, 0)
        self.changed = self._waited >= self._patience
        if self.changed:
            self._waited = 0

    def apply(self, echo: Samples) -> Samples:
        """The echo (hop,) with its weight, which falls at once and rises over a part."""
        if not self._limited:
            return echo
        target = self._weights[1:]
        start = np.minimum(self._weights[:-1], target)
        gain = start[:, None] + (target - start)[:, None] * self._ramp
        return gain.reshape(-1) * echo


def _weight(part: float | np.ndarray) -> np.ndarray:
    """The echo's weight where so much of it is heard."""
    return np.where(part < ABSENT, 0.0, np.minimum(part, 1.0))
