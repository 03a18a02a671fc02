"""How far a loudspeaker's membrane moves: stiffness holds it below its resonance, mass above."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.dsp import fourier
from edgefilter.types import SAMPLE_RATE, Array, Samples, Spectrum

LOWEST_HZ = 150.0
"""From here up any robot's loudspeaker plays."""
DISPLACEMENT_HZ = 300.0
"""Corner of the second-order low-pass that turns what is played into the displacement of the membrane."""
DISPLACEMENT_TAPS = 128
"""Length of its impulse response, 8 ms: what comes later is 80 dB below its peak."""
MOTION_Q = 0.8
"""Of a small driver in its box; from 0.6 to 1 what its distortion explains hardly changes."""
MOTION_TAPS = 256
"""Samples in which a membrane of that Q and at least 160 Hz comes to rest, by 87 dB: 16 ms."""


@lru_cache(maxsize=1)
def displacement_taps() -> Array:
    """Impulse response (DISPLACEMENT_TAPS,) float64, not to be written to, of the low-pass; its gain is 1 at 0 Hz.

    A Butterworth low-pass, sampled in frequency, so that the running filter needs no scipy.signal.
    """
    size = 8 * DISPLACEMENT_TAPS
    return fourier.irfft(_responses(size, DISPLACEMENT_HZ, np.sqrt(0.5))[0], size)[:DISPLACEMENT_TAPS]


def motion(x: Samples, resonance_hz: float, sample_rate: int = SAMPLE_RATE) -> Samples:
    """Displacement d and velocity d'/w of a membrane of that resonance and MOTION_Q that x (n,) drives: (2, n), in x's full scale.

    Multiplied in frequency: three transforms a hop.
    """
    if not x.size:
        return np.zeros((2, 0), np.float32)
    size = fft.next_fast_len(x.size + MOTION_TAPS, real=True)
    padded = np.zeros(size, np.float32)
    padded[: x.size] = x
    return fourier.irfft(_motion(size, float(resonance_hz), sample_rate) * fourier.rfft(padded), size)[:, : x.size]


@lru_cache(maxsize=2)
def _motion(size: int, resonance_hz: float, sample_rate: int) -> Spectrum:
    return _responses(size, resonance_hz, MOTION_Q, sample_rate).astype(np.complex64)


def _responses(size: int, hz: float, q: float, sample_rate: int = SAMPLE_RATE) -> NDArray[np.complex128]:
    """Responses from drive to displacement and velocity, of w^2 / (s^2 + s w / Q + w^2) by the bilinear transform, (2, size // 2 + 1)."""
    k = np.tan(np.pi * hz / sample_rate)
    z = np.exp(-2j * np.pi * np.arange(size // 2 + 1) / size)
    rest = k**2 * (1 + z) ** 2 + k / q * (1 - z**2) + (1 - z) ** 2
    return np.stack((k**2 * (1 + z) ** 2 / rest, k * (1 - z**2) / rest))
