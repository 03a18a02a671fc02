"""No echo is subtracted that makes the result louder than the microphone: a limiter on the echo's weight."""

from __future__ import annotations

import numpy as np

from edgefilter.types import SAMPLE_RATE, Samples

MEMORY = 0.8
"""Weight of the past in the smoothed powers per hop of 16 ms; about 80 ms."""
GROSS = 2.0
"""Power of a single hop's error over the microphone's, from which on it is limited whatever the smoothed powers say."""
EXCESS = 1.5
"""Smoothed error power over smoothed microphone power from which on the path is not adapted: the echo is not there."""
PATIENCE_S = 0.5
"""Seconds of robot after which an echo that is too loud, the lag being known, is put down to the path."""
RAMP = 64
"""Samples, 4 ms, over which the weight changes."""


class EchoLimiter:
    """Weighs the echo by gamma = <mic, echo> / <echo, echo>, in 0 to 1, while subtracting all of it would add power.

    hop: samples per step. changed: the path must have become another one, told once for each such time.
    """

    def __init__(self, hop: int) -> None:
        self._patience = round(PATIENCE_S * SAMPLE_RATE / hop)
        self._ramp = (np.arange(min(RAMP, hop), dtype=np.float32) + 1.0) / min(RAMP, hop)
        self._heard = self._cross = self._expected = 0.0
        self._weight = self._before = 1.0
        self._excessive, self._waited = False, 0
        self.changed = False

    def measure(self, mic: Samples, echo: Samples) -> bool:
        """Take in a hop (hop,) of both; whether the echo is too loud."""
        heard, cross, expected = float(mic.dot(mic)), float(mic.dot(echo)), float(echo.dot(echo))
        self._heard += (1.0 - MEMORY) * (heard - self._heard)
        self._cross += (1.0 - MEMORY) * (cross - self._cross)
        self._expected += (1.0 - MEMORY) * (expected - self._expected)
        left = heard - 2.0 * cross + expected
        smoothed = self._heard - 2.0 * self._cross + self._expected
        limited = left > heard and (smoothed > self._heard or left > GROSS * heard)
        self._before = self._weight
        self._weight = min(max(cross / expected, 0.0), 1.0) if limited else 1.0
        self._excessive = left > EXCESS * heard
        return limited

    def may_adapt(self) -> bool:
        """Whether the path may be adapted by this hop's error, the lag being known."""
        self.changed = False
        if not self._excessive:
            self._waited = max(self._waited - 1, 0)
            return True
        self._waited += 1
        if self._waited < self._patience:
            return False
        self.changed, self._waited = True, 0
        return True

    def apply(self, echo: Samples) -> Samples:
        """The echo (hop,) with its weight."""
        if self._before == self._weight == 1.0:
            return echo
        out = self._weight * echo
        ramp = self._ramp
        out[: ramp.size] = (self._before + (self._weight - self._before) * ramp) * echo[: ramp.size]
        return out
