"""Power spectral densities: one-sided, full scale^2 per Hz, from 0 to 8 kHz, unless said otherwise."""

from __future__ import annotations

import numpy as np
from scipy import fft

from edgefilter.dsp.convolution import TOGETHER
from edgefilter.dsp.fourier import power
from edgefilter.dsp.frames import frames
from edgefilter.types import SAMPLE_RATE, Array, Samples

GRID_FFT = 1200
"""FFT length of the frequency grid of profiles and of most power spectral densities: 601 bins, as Li et al. (2024) have."""
GRID_BINS = GRID_FFT // 2 + 1
ROUNDING_PSD = 1e-14
"""PSD of rounding to 16 bit: (2^-15)^2 / 12 / 8 kHz, rounded down."""
NOTCH = 1e-7
"""A PSD counts as no less than this part of its maximum, 70 dB, so that a notch is not amplified beyond reason."""


def hann(size: int) -> Array:
    """The periodic Hann window, whose shifted copies add up to a constant, (size,) float64."""
    return np.hanning(size + 1)[:-1]


def periodograms(x: Samples, size: int) -> Array:
    """PSD of each half-overlapping Hann frame of x (n,), (f, size / 2 + 1): their mean is Welch's estimate (1967)."""
    window, read = hann(size), frames(x, size, size // 2)
    found = np.empty((read.shape[0], size // 2 + 1))
    for at in range(0, read.shape[0], TOGETHER):
        found[at : at + TOGETHER] = power(fft.rfft(read[at : at + TOGETHER] * window, axis=1))
    found /= SAMPLE_RATE * np.sum(window**2)
    found[:, 1:-1] *= 2.0
    return found


def frequencies(bins: int) -> Array:
    """Frequencies of the bins, 0 to 8 kHz, (bins,) in Hz."""
    return np.arange(bins) * (0.5 * SAMPLE_RATE / (bins - 1))


def floored(psd: Samples) -> Array:
    """The PSD (bins,), float64, as one divides by it: held above 16 bit rounding noise and 70 dB under its maximum."""
    return np.maximum(psd.astype(np.float64), max(ROUNDING_PSD, NOTCH * float(psd.max())))


def variance_at(hz: Array, psd: Samples) -> Array:
    """Two-sided density per sample of the PSD (bins,) at hz; |spectrum|^2 is that times the sum of the squared window."""
    return np.interp(hz, frequencies(psd.size), psd) / 2 * SAMPLE_RATE


def coloured(rng: np.random.Generator, size: int, psd: Samples) -> Array:
    """Gaussian noise of that PSD (bins,), (size,)."""
    fast = fft.next_fast_len(size, real=True)
    amplitude = np.sqrt(variance_at(fft.rfftfreq(fast, 1 / SAMPLE_RATE), psd))
    return fft.irfft(fft.rfft(rng.standard_normal(fast)) * amplitude, fast)[:size]


def total_power(psd: Samples) -> float:
    """Mean square of noise of that PSD (bins,)."""
    return float(np.sum(psd)) * (SAMPLE_RATE / 2) / (psd.size - 1)


def third_octave_bands() -> Array:
    """Third-octave bands of 50 Hz to 8 kHz (IEC 61260-1, 5.4, base ten), the last cut at 8 kHz, (B, 2) in Hz."""
    centres = 1000.0 * 10 ** (np.arange(-13, 10) / 10)
    edges = np.stack((centres * 10**-0.05, centres * 10**0.05), axis=1)
    return np.minimum(edges, SAMPLE_RATE / 2)


def mel_edges(bins: int, bands: int, lowest_hz: float) -> np.ndarray:
    """First bins (at most bands,) of bands as wide as the ear's, from lowest_hz to 8 kHz, of a spectrum (bins,).

    The mel scale of O'Shaughnessy (1987), 2595 lg(1 + f / 700 Hz). For np.add.reduceat.
    """
    lowest, highest = (2595.0 * np.log10(1.0 + hz / 700.0) for hz in (lowest_hz, SAMPLE_RATE / 2))
    hz = 700.0 * (10.0 ** (np.linspace(lowest, highest, bands + 1) / 2595.0) - 1.0)
    return np.unique(np.round(hz * 2 * (bins - 1) / SAMPLE_RATE).astype(int))[:-1]
