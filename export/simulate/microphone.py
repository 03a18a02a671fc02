"""What a microphone and the electronics behind it do to everything that is heard: filters, gain control, clipping, suppression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from edgefilter.profile.data import GRID_HZ
from edgefilter.types import SAMPLE_RATE, Samples

HIGH_PASS, BAND_LIMIT, GAIN_CONTROL, CLIPPING = 0.4, 0.25, 0.2, 0.1
"""Shares of wide items."""
WINDOW = signal.ShortTimeFFT(signal.windows.hann(512, sym=False), 128, SAMPLE_RATE, fft_mode="onesided")
"""Frames of the device's noise suppression."""


@dataclass(frozen=True)
class Suppression:
    """The noise suppression that a device brings, one gain on everything that is heard, after Boll (1979).

    over: times the noise (the tenth percentile of the power) that is subtracted. floor_db: least gain. jitter_db: standard
    deviation of what other processing adds to the gain, drawn anew every 1 / jitter_hz seconds in each of jitter_bands: no
    linear filter can follow it.
    """

    over: float
    floor_db: float
    jitter_db: float
    jitter_hz: float
    jitter_bands: int
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Suppression:
        return cls(
            over=rng.uniform(1.0, 6.0),
            floor_db=rng.uniform(-35.0, -8.0),
            jitter_db=rng.uniform(0.0, 8.0),
            jitter_hz=rng.uniform(4.0, 40.0),
            jitter_bands=int(rng.integers(1, 33)),
            seed=int(rng.integers(2**31)),
        )

    def applied(self, heard: Samples, *parts: Samples) -> list[Samples]:
        """All of them (n,) with the gain that was found on the first: what is heard, and parts of it."""
        spectra = [WINDOW.stft(samples) for samples in (heard, *parts)]
        power = np.abs(spectra[0]) ** 2
        noise = np.quantile(power, 0.1, axis=1, keepdims=True)
        gain = np.maximum(1.0 - self.over * noise / np.maximum(power, 1e-12), 10 ** (self.floor_db / 20))
        gain = np.maximum(gain, signal.lfilter([0.3], [1, -0.7], gain, axis=1))  # falls slowly
        bins, frames = gain.shape
        knots = 2 + int(self.jitter_hz * heard.size / SAMPLE_RATE)
        jitter = np.random.default_rng(self.seed).normal(0.0, self.jitter_db, (self.jitter_bands, knots))
        jitter = jitter[np.arange(bins) * self.jitter_bands // bins]
        places = np.linspace(0, knots - 1, frames)
        jitter = np.stack([np.interp(places, np.arange(knots), row) for row in jitter])
        gain = gain * 10 ** (jitter / 20)
        return [WINDOW.istft(gain * spectrum, k1=heard.size).astype(np.float32) for spectrum in spectra]


@dataclass(frozen=True)
class Microphone:
    """A microphone. sections: of its linear filter, second order.

    gain_db, gain_hz: knots of its gain control, how many a second. clip: part of the peak that it passes. suppression: of
    noise.
    """

    sections: np.ndarray | None = None
    gain_db: np.ndarray | None = None
    gain_hz: float = 1.0
    clip: float = 1.0
    suppression: Suppression | None = None

    @classmethod
    def draw(cls, rng: np.random.Generator, wideness: float, seconds: float, processed: float = 0.0) -> Microphone:
        """The same numbers are drawn whether a defect is there or not, but those of a suppression. processed: share with one."""
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
            Suppression.draw(rng) if rng.random() < processed else None,
        )

    def filtered(self, x: Samples) -> Samples:
        """Apply the linear filter to x (n,)."""
        return x if self.sections is None else signal.sosfilt(self.sections, x).astype(np.float32)

    def power(self) -> Samples:
        """Squared magnitude of the linear filter on GRID_HZ, (601,)."""
        if self.sections is None:
            return np.ones(GRID_HZ.size)
        return np.abs(signal.sosfreqz(self.sections, GRID_HZ, fs=SAMPLE_RATE)[1]) ** 2

    def gain(self, samples: int) -> Samples:
        """Gain of the gain control, (n,)."""
        if self.gain_db is None:
            return np.ones(samples, np.float32)
        places = np.arange(samples) * self.gain_hz / SAMPLE_RATE
        return (10 ** (np.interp(places, np.arange(self.gain_db.size), self.gain_db) / 20)).astype(np.float32)
