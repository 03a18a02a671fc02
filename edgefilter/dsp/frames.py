"""A signal in pieces: a stretch of it, overlapping frames, whole blocks, the power of each, in decibels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgefilter.types import Array, Samples

SILENT = 10**-4.5
"""Power, 45 dB under the loudest of a voice, under which it is silent."""
DB_PER_NEPER = 20.0 / np.log(10.0)


def stretch(x: NDArray, start: int, stop: int) -> NDArray:
    """Samples start..stop-1 of x (n,), a new array (stop - start,), zeros where x has none."""
    out = np.zeros(stop - start, x.dtype)
    first, last = max(start, 0), min(stop, x.size)
    if last > first:
        out[first - start : last - start] = x[first:last]
    return out


def rise(size: int) -> Array:
    """Half a cosine from 0 up to 1, (size,) float64: what a sound is faded in with."""
    return 0.5 - 0.5 * np.cos(np.pi * (np.arange(size) + 0.5) / size)


def frames(x: NDArray, size: int, hop: int) -> NDArray:
    """Frames of x (n,), hop samples apart, (f, size), a view not to be written to; none where x is shorter."""
    if x.size < size:
        return np.zeros((0, size), x.dtype)
    return np.lib.stride_tricks.sliding_window_view(x, size)[::hop]


def blocks(x: NDArray, size: int) -> NDArray:
    """The whole blocks of x (n,), (k, size), a view; what is left at the end is left out."""
    count = x.size // size
    return x[: count * size].reshape(count, size)


def block_power(x: Array, size: int) -> Array:
    """Mean square of x (n,) in each whole block, (k,) float64."""
    return np.square(blocks(x, size), dtype=np.float64).mean(axis=1)


def block_sums(x: NDArray, size: int) -> Array:
    """Sum of x (n,) over each whole block, (k,) float64."""
    return blocks(x, size).sum(axis=1, dtype=np.float64)


def all_block_power(x: Samples, size: int) -> Array:
    """Mean square in each block, the last one counted as if silence followed, (k,) float64."""
    return np.add.reduceat(x.astype(np.float64) ** 2, np.arange(0, x.size, size)) / size


def decibels(power: Array | np.floating | float, least: float = 1e-12) -> Array:
    """10 lg of a power, at least that of `least`."""
    return DB_PER_NEPER / 2.0 * np.log(np.maximum(power, least))


def amplitude(gain_db: Array) -> Array:
    """The factor that a gain in dB is; faster than a power of ten."""
    return np.exp(gain_db / DB_PER_NEPER)
