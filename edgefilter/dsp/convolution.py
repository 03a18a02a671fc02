"""The convolution of a recording with a filter, in blocks of which some are transformed together."""

from __future__ import annotations

import numpy as np
from scipy import fft

from edgefilter.dsp.frames import frames
from edgefilter.types import Array, Samples

TOGETHER = 8
"""Blocks or frames that are transformed at once, so that memory stays bounded."""
FEW = 4
"""Taps up to which a filter is faster by sums than by transforms."""


def convolve(x: Array, taps: Array) -> Array:
    """The full convolution of x (n,) and taps (t,), (n + t - 1,), float32 where both are.

    Overlap-save (Oppenheim & Schafer, Discrete-Time Signal Processing, 8.7.3): in blocks of about four
    filter lengths, of each of which the first t - 1 samples, which wrap around, are left out. Takes half the time of scipy.signal.oaconvolve.
    """
    before, whole = taps.size - 1, x.size + taps.size - 1
    size = 1 << max(4 * taps.size, 1024).bit_length()
    if whole <= size:
        size = fft.next_fast_len(whole, real=True)
        return fft.irfft(fft.rfft(x, size) * fft.rfft(taps, size), size)[:whole]
    new = size - before
    count = -(-whole // new)
    read, response = frames(np.pad(x, (before, count * new - x.size)), size, new), fft.rfft(taps, size)
    out = np.empty((count, new), np.result_type(x, taps))
    for at in range(0, count, TOGETHER):
        out[at : at + TOGETHER] = fft.irfft(fft.rfft(read[at : at + TOGETHER]) * response, size)[:, before:]
    return out.ravel()[:whole]


def filtered(x: Samples, taps: Array, lead: int = 0) -> Samples:
    """The signal x (n,) through taps (t,), tap k a delay of k - lead samples, (n,) float32."""
    taps = taps.astype(np.float32)
    if not x.size or not taps.any():
        return np.zeros(x.size, np.float32)
    whole = np.convolve(x, taps) if taps.size <= FEW else convolve(x, taps)
    whole = np.pad(whole, (0, max(lead + x.size - whole.size, 0)))
    return whole[lead : lead + x.size].astype(np.float32, copy=False)
