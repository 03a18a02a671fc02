"""A ring buffer of samples that counts what it lost, for one writer and one reader."""

from __future__ import annotations

import numpy as np

from edgefilter.types import Samples


class Ring:
    """First in, first out, float32. channels: samples are then (n, channels) in place of (n,), and counted once.

    Writing never blocks: what does not fit is not stored and is added to `lost`, so an audio callback can write and
    return. One thread may write while another reads; each side moves only its own counter.
    """

    def __init__(self, capacity: int, channels: int | None = None) -> None:
        if capacity <= 0:
            raise ValueError(f"ring capacity is {capacity}, expected at least one sample")
        self._data = np.zeros(capacity if channels is None else (capacity, channels), np.float32)
        self._written = 0
        self._read = 0
        self.lost = 0

    def __len__(self) -> int:
        """Samples that can be read now."""
        return self._written - self._read

    @property
    def capacity(self) -> int:
        """Samples that it holds at most."""
        return len(self._data)

    def write(self, samples: Samples) -> int:
        """Store as many of samples (n,) as fit and return how many; the rest is counted in `lost`."""
        count = min(len(samples), len(self._data) - len(self))
        at = self._written % len(self._data)
        first = min(count, len(self._data) - at)
        self._data[at : at + first] = samples[:first]
        self._data[: count - first] = samples[first:count]
        self.lost += len(samples) - count
        self._written += count
        return count

    def read(self, count: int) -> Samples:
        """Return and remove up to count samples, the oldest first, as a new array."""
        count = min(count, len(self))
        at = self._read % len(self._data)
        first = min(count, len(self._data) - at)
        out = np.concatenate((self._data[at : at + first], self._data[: count - first]))
        self._read += count
        return out
