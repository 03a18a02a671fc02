"""How far a loudspeaker's membrane moves: stiffness holds it below its resonance, mass above."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.types import SAMPLE_RATE, Array

DISPLACEMENT_HZ = 300.0
"""Corner of the second-order low-pass that turns what is played into the displacement of the membrane."""
DISPLACEMENT_TAPS = 128
"""Length of its impulse response, 8 ms: what comes later is 80 dB below its peak."""


@lru_cache(maxsize=4)
def displacement_taps(sample_rate: int = SAMPLE_RATE) -> Array:
    """Impulse response (DISPLACEMENT_TAPS,) float64, not to be written to, of the low-pass; its gain is 1 at 0 Hz.

    A Butterworth low-pass by the bilinear transform, sampled in frequency, so that the running filter needs no
    scipy.signal.
    """
    k = np.tan(np.pi * DISPLACEMENT_HZ / sample_rate)
    z = np.exp(-2j * np.pi * np.arange(8 * DISPLACEMENT_TAPS // 2 + 1) / (8 * DISPLACEMENT_TAPS))
    response = k**2 * (1 + z) ** 2 / (k**2 * (1 + z) ** 2 + np.sqrt(2) * k * (1 - z**2) + (1 - z) ** 2)
    return fourier.irfft(response, 8 * DISPLACEMENT_TAPS)[:DISPLACEMENT_TAPS]
