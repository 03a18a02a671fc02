"""A histogram of compute times, in constant memory."""

from __future__ import annotations

import math
from collections import Counter

WIDTH = 1.05
"""Upper over lower bound of a bin: finer than any two runs agree."""
LOWEST_MS = 1e-3
"""What takes less than 1 us counts as 1 us."""


class Histogram:
    """Counts times in bins of 5 % width from 1 us up.

    Mean and maximum are exact, percentiles to the width of a bin.

    >>> times = Histogram()
    >>> for ms in range(1, 101):
    ...     times.add(ms)
    >>> times.count, times.max_ms, abs(times.percentile(50) / 50 - 1) < 0.05
    (100, 100, True)
    """

    def __init__(self) -> None:
        self._bins: Counter[int] = Counter()
        self.count = 0
        self.sum_ms = self.max_ms = 0.0

    def add(self, ms: float) -> None:
        """Note one time, ms >= 0."""
        self._bins[math.floor(math.log(max(ms, LOWEST_MS), WIDTH))] += 1
        self.count += 1
        self.sum_ms += ms
        self.max_ms = max(self.max_ms, ms)

    def percentile(self, percent: float) -> float:
        """The time in ms under which so many percent of the times lie; 0 without any."""
        below = 0
        for at, count in sorted(self._bins.items()):
            below += count
            if below >= percent / 100 * self.count:
                return min(WIDTH ** (at + 0.5), self.max_ms)
        return 0.0

    def to_dict(self) -> dict[str, float]:
        """mean, p50, p95, p99 and max in ms, ready for JSON."""
        mean = self.sum_ms / self.count if self.count else 0.0
        return {"mean_ms": mean, **{f"p{p}_ms": self.percentile(p) for p in (50, 95, 99)}, "max_ms": self.max_ms}
