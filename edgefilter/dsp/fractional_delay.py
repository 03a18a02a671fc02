"""Reading a signal between its samples: a windowed sinc where the delay moves, the spectrum's phase where it holds."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

from edgefilter.dsp.lag import turn
from edgefilter.types import Array, Samples

HALF_WIDTH = 24
"""Zero crossings of the interpolating sinc on each side. With the window below its error is under -110 dB up to 6 kHz,
-90 dB at 6.8 kHz, -55 dB at 7 kHz and -35 dB at 7.2 kHz, at the worst fraction."""
PHASES = 256
"""Delays per sample at which the filters are tabulated; linear interpolation between them errs by less than -100 dB."""
CHUNK = 2048
"""Samples that are made at once: their filters stay in the cache, and a sentence needs no more memory than a frame."""


def kernel(fraction: Array) -> Samples:
    """Windowed-sinc filters that delay by fraction (m,) samples, each within about -1..2; (m, 2 * HALF_WIDTH) float32.

    Tap k weighs the sample k - HALF_WIDTH + 1 behind the present one. h(k) = sinc(k - d) w(k - d) with the four-term
    Nuttall window (1981, eq. 34) taken at the shifted position, so that the filter is exact for a whole number.
    """
    position = np.arange(1 - HALF_WIDTH, HALF_WIDTH + 1) - np.asarray(fraction, float)[:, None]
    phase = np.clip(position / (HALF_WIDTH + 1.0), -1.0, 1.0) * np.pi
    c = np.cos(phase)
    window = 0.355768 + 0.487396 * c + 0.144232 * (2 * c * c - 1) + 0.012604 * (4 * c * c - 3) * c
    return (np.sinc(position) * window).astype(np.float32)


@lru_cache(maxsize=1)
def tabulated() -> tuple[Samples, Samples]:
    """The filters for delays of -1 to 2, every 1 / PHASES, last tap first, and their slopes, (3 PHASES, 2 HALF_WIDTH) each."""
    table = kernel(np.arange(3 * PHASES + 1) / PHASES - 1.0)[:, ::-1]
    return np.ascontiguousarray(table[:-1]), np.diff(table, axis=0)


def interpolate(x: Samples, positions: Array) -> Samples:
    """The signal x (n,) at real positions (m,), in samples; (m,) float32, outside of x there is silence."""
    table, slope = tabulated()
    out = np.zeros(positions.size, np.float32)
    padded = np.pad(x, (2 * HALF_WIDTH, 2 * HALF_WIDTH))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF_WIDTH)
    for at in range(0, positions.size, CHUNK):
        p = np.clip(positions[at : at + CHUNK], -HALF_WIDTH - 1.0, x.size + HALF_WIDTH - 1.0)
        base = np.floor(p).astype(np.int64)
        phase = (base + 2 - p) * PHASES  # the sample base + 1, delayed by base + 1 - p
        step = phase.astype(np.int64)
        weights = slope[step]
        weights *= (phase - step).astype(np.float32)[:, None]
        weights += table[step]
        begin = int(base[0]) + HALF_WIDTH + 1
        in_turn = bool((np.diff(base) == 1).all())  # nearly always, and then a view spares a copy of each window
        read = windows[begin : begin + p.size] if in_turn else windows[base + HALF_WIDTH + 1]
        out[at : at + CHUNK] = np.einsum("ij,ij->i", read, weights)
    return out


def delayed(x: Array, samples: float) -> Samples:
    """The signal x (n,) later by a constant number of samples, fractional or negative; (n,) float32, silence moves in.

    By the phase of its spectrum, which keeps the band above 7 kHz, where the kernel falls off.
    """
    if abs(samples) >= x.size:
        return np.zeros(x.size, np.float32)
    # silence where the spectrum joins end and beginning
    n = fft.next_fast_len(x.size + int(abs(samples)) + 256, real=True)
    spectrum = fft.rfft(x.astype(np.float64), n)
    spectrum *= turn(np.arange(n // 2 + 1) * (-2.0 * np.pi / n), samples)
    return fft.irfft(spectrum, n, overwrite_x=True)[: x.size].astype(np.float32)
