"""How long hops took, kept in constant memory."""

from __future__ import annotations

import math

import numpy as np

LOWEST_MS, DECADES, PER_DECADE = 1e-3, 7, 48


class Histogram:
    """Counts times in bins of 5 % width from 1 us to 10 s.

    Mean and maximum are exact, percentiles to the width of a bin.

    >>> times = Histogram()
    >>> for ms in range(1, 101):
    ...     times.add(ms)
    >>> times.count, times.max_ms, abs(times.percentile(50) / 50 - 1) < 0.05
    (100, 100, True)
    """

    def __init__(self) -> None:
        self._bins = [0] * (DECADES * PER_DECADE)
        self.count = 0
        self.sum_ms = self.max_ms = 0.0

    def add(self, ms: float) -> None:
        """Note one time, ms >= 0."""
        at = int(PER_DECADE * math.log10(max(ms, LOWEST_MS) / LOWEST_MS))
        self._bins[min(at, len(self._bins) - 1)] += 1
        self.count += 1
        self.sum_ms += ms
        self.max_ms = max(self.max_ms, ms)

    def percentile(self, percent: float) -> float:
        """Ms under which percent of the times lie; 0 without any."""
        if not self.count:
            return 0.0
        at = int(np.searchsorted(np.cumsum(self._bins), percent / 100 * self.count))
        return min(LOWEST_MS * 10 ** ((at + 0.5) / PER_DECADE), self.max_ms)

    def to_dict(self) -> dict[str, float]:
        """mean, p50, p95, p99 and max in ms, ready for JSON."""
        mean = self.sum_ms / self.count if self.count else 0.0
        return {"mean_ms": mean, **{f"p{p}_ms": self.percentile(p) for p in (50, 95, 99)}, "max_ms": self.max_ms}
