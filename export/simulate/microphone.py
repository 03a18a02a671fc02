"""What a microphone and the electronics behind it do to everything that is heard: filters, gain control, clipping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from edgefilter.profile.data import GRID_HZ
from edgefilter.types import SAMPLE_RATE, Samples

HIGH_PASS, BAND_LIMIT, GAIN_CONTROL, CLIPPING = 0.4, 0.25, 0.2, 0.1
"""Shares of wide items."""


@dataclass(frozen=True)
class Microphone:
    """sections: of its linear filter, second order.

    gain_db, gain_hz: knots of its gain control, how many a second. clip: part of the peak that it passes.
    """

    sections: np.ndarray | None = None
    gain_db: np.ndarray | None = None
    gain_hz: float = 1.0
    clip: float = 1.0

    @classmethod
    def draw(cls, rng: np.random.Generator, wideness: float, seconds: float) -> Microphone:
        """The same numbers are drawn whether a defect is there or not."""
        high_pass, band_limit, gain_control, clipping = rng.random(4) < wideness * np.array(
            [HIGH_PASS, BAND_LIMIT, GAIN_CONTROL, CLIPPING]
        )
        low, high, order = rng.uniform(50, 200), rng.uniform(3400, 7900), int(rng.integers(2, 7))
        gain_hz, most = rng.uniform(0.3, 2.0), rng.uniform(2, 10)
        clip = rng.uniform(0.25, 0.8)
        walk = np.cumsum(rng.standard_normal(int(seconds * gain_hz) + 2))
        sections = []
        if high_pass:
            sections.append(signal.butter(2, low, "high", fs=SAMPLE_RATE, output="sos"))
        if band_limit:
            sections.append(signal.butter(order, high, fs=SAMPLE_RATE, output="sos"))
        return cls(
            np.concatenate(sections) if sections else None,
            most * walk / np.abs(walk).max() if gain_control else None,
            gain_hz,
            clip if clipping else 1.0,
        )

    def filtered(self, x: Samples) -> Samples:
        """X (n,) after the linear filter."""
        return x if self.sections is None else signal.sosfilt(self.sections, x).astype(np.float32)

    def power(self) -> Samples:
        """(601,) squared magnitude of the linear filter on GRID_HZ."""
        if self.sections is None:
            return np.ones(GRID_HZ.size)
        return np.abs(signal.sosfreqz(self.sections, GRID_HZ, fs=SAMPLE_RATE)[1]) ** 2

    def gain(self, samples: int) -> Samples:
        """(n,) of the gain control."""
        if self.gain_db is None:
            return np.ones(samples, np.float32)
        places = np.arange(samples) * self.gain_hz / SAMPLE_RATE
        return (10 ** (np.interp(places, np.arange(self.gain_db.size), self.gain_db) / 20)).astype(np.float32)
