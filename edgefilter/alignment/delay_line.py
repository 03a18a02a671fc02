"""Samples by their absolute position, and reading them with a fractional delay that changes smoothly."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from edgefilter.dsp.fractional_delay import HALF_WIDTH, PHASES, tabulated
from edgefilter.dsp.frames import stretch
from edgefilter.types import Array, Samples

WAIT = 160
"""Samples, 10 ms, that the microphone waits at most for a reference that comes after its echo: the end of the latest frame is left to
the next one, so that the output comes no later. At 13 ms of lateness frames are so short that a real device lost 4 dB of the human."""


class DelayBuffer:
    """The last `capacity` samples of a stream, addressed by the sample counter; samples that never were are zero."""

    def __init__(self, capacity: int) -> None:
        self._data = np.zeros(2 * capacity, np.float32)
        self.capacity = self._at = capacity
        self.end = 0

    def push(self, samples: Samples) -> None:
        """Append samples (n,), n <= capacity."""
        if self._at + samples.size > self._data.size:
            self._data[: self.capacity] = self._data[self._at - self.capacity : self._at]
            self._at = self.capacity
        self._data[self._at : self._at + samples.size] = samples
        self._at += samples.size
        self.end += samples.size

    def rewrite(self, start: int, samples: Samples) -> None:
        """Replace what is kept from position start on by samples (n,), which may reach neither before it nor beyond the end."""
        offset = self._at - self.end + start
        self._data[offset : offset + samples.size] = samples

    def read(self, start: int, stop: int) -> Samples:
        """Samples start..stop-1 (stop - start,), a view where possible; zeros after the end and before what is kept."""
        oldest = self.end - self.capacity
        offset = self._at - self.end
        if start >= oldest and stop <= self.end:
            return self._data[start + offset : stop + offset]
        return stretch(self._data[self._at - self.capacity : self._at], start - oldest, stop - oldest)


@lru_cache(maxsize=1)
def kernel_table() -> tuple[list[Samples], list[Samples]]:
    """The kernel table and its slopes by rows: one of a list is found several times as fast as one of an array."""
    table, step = tabulated()
    return list(table), list(step)


def _kernels(*delays: float) -> Array:
    """Filters (m, 2 * HALF_WIDTH) for m delays of -1 to 2, last tap first, from the table."""
    table, step = kernel_table()
    filters = []
    for delay in delays:
        at = (delay + 1.0) * PHASES
        below = int(at)
        filters.append(table[below] + step[below] * (at - below))
    return np.array(filters)


def read_delayed(buffer: DelayBuffer, stop: int, count: int, delay_from: float, delay_to: float) -> Samples:
    """The buffer at the positions stop - count to stop - 1, less a delay that moves, (count,) float32.

    The delay is delay_from just before the first sample and delay_to, less than 1 away, at the last one. Filters for the two
    ends and the middle are applied to the whole stretch and interpolated by a parabola, which for a stretch of 256 samples
    at 300 ppm errs by less than -75 dB at any frequency.
    """
    middle = 0.5 * (delay_from + delay_to)
    whole = math.floor(middle)
    source = buffer.read(stop - count - whole - HALF_WIDTH, stop - whole + HALF_WIDTH - 1)
    shifted = np.ndarray((2 * HALF_WIDTH, count), np.float32, source, 0, 2 * source.strides)
    filtered = _kernels(delay_from - whole, middle - whole, delay_to - whole).dot(shifted)
    filtered *= _parabola(count)
    return filtered[0] + filtered[1] + filtered[2]


@lru_cache(maxsize=8)
def _parabola(count: int) -> Array:
    """Weights of the values at the start, middle and end of count samples, (3, count)."""
    u = np.arange(1, count + 1, dtype=np.float32) / np.float32(count)
    return np.stack(((2 * u - 1) * (u - 1), 4 * u * (1 - u), u * (2 * u - 1)))


def read_line(buffer: DelayBuffer, stop: int, count: int, delay: float, slope: float, chunk: int = 256) -> Samples:
    """As read_delayed for any count, with a delay that is `delay` at the last sample and grows by slope per sample."""
    pieces = []
    for start in range(0, count, chunk):
        size = min(chunk, count - start)
        end = stop - count + start + size
        to = delay - slope * (stop - end)
        pieces.append(read_delayed(buffer, end, size, max(to - slope * size, 0.0), max(to, 0.0)))
    return np.concatenate(pieces) if pieces else np.zeros(0, np.float32)
