"""Real Fourier transforms along the last axis, for code that runs once a hop.

scipy.fft finds out anew at every call whose array it was given: 4 us, and 0.15 ms with cold caches. So its kernel is called
directly where scipy keeps it, and scipy.fft only where it is not there; the numbers are the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.types import Array, Samples, Spectrum

try:
    from scipy.fft._pocketfft import pypocketfft as _kernel

    _kernel.c2r(_kernel.r2c(np.zeros(2, np.float32), (0,), True, 0, None, 1), (0,), 2, False, 2, None, 1)
except (ImportError, AttributeError, TypeError):
    _kernel = None

TINY = np.float32(1e-30)
"""Power to add to a divisor that may be zero, far below that of any sound."""
LEAST = 1e-9
"""Least power, -90 dB, of noise beside the loudest sound so far: of nothing, as of a muted microphone, no ratio could be told."""
_SINGLE, _COMPLEX = np.dtype(np.float32), np.dtype(np.complex64)


def rfft(x: Samples, out: Spectrum | None = None) -> Spectrum:
    """Spectrum (..., n // 2 + 1) of x (..., n), float32 or float64; written to out where given, which then is returned."""
    if _kernel is None or (x.dtype is not _SINGLE and x.dtype != np.float64):
        return _into(out, fft.rfft(x))
    return _kernel.r2c(x, (x.ndim - 1,), True, 0, out, 1)


def irfft(spectrum: Spectrum, n: int, out: Samples | None = None) -> Samples:
    """Samples (..., n) of a spectrum (..., n // 2 + 1), complex64 or 128; written to out where given, which then is returned."""
    if _kernel is None or (spectrum.dtype is not _COMPLEX and spectrum.dtype != np.complex128):
        return _into(out, fft.irfft(spectrum, n))
    return _kernel.c2r(spectrum, (spectrum.ndim - 1,), n, False, 2, out, 1)


def power(spectrum: np.ndarray) -> np.ndarray:
    """Return |spectrum|^2 without the square root of abs, real and of the same precision."""
    return spectrum.real**2 + spectrum.imag**2


def log_response(log_gain: Array) -> NDArray[np.complex128]:
    """Complex logarithm of the causal response of least phase with that gain, from its logarithm, 0 to Nyquist, (bins, ...).

    By its real cepstrum, folded onto positive times (Oppenheim & Schafer 2010, section 13.5).
    """
    bins = log_gain.shape[0]
    cepstrum = fft.irfft(log_gain, axis=0)
    cepstrum[1 : bins - 1] *= 2.0
    cepstrum[bins:] = 0.0
    return fft.rfft(cepstrum, axis=0)


def _into(out: np.ndarray | None, found: np.ndarray) -> np.ndarray:
    if out is None:
        return found
    out[...] = found
    return out
