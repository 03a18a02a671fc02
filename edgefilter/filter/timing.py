"""What a process costs: a histogram of compute times, in constant memory, and its peak memory."""

from __future__ import annotations

import math
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path

try:
    import resource
except ModuleNotFoundError:  # Windows has no such module
    resource = None  # type: ignore[assignment]

STATUS = Path("/proc/self/status")
"""Where Linux tells what a process has had since it was started."""
WIDTH = 1.05
"""Upper over lower bound of a bin: finer than any two runs agree."""


class Histogram:
    """Counts times in bins of 5 % width from 1 us up: mean and maximum are exact, percentiles to the width of a bin."""

    def __init__(self) -> None:
        self._bins: Counter[int] = Counter()
        self.count = 0
        self.sum_ms = self.max_ms = 0.0

    def add(self, ms: float) -> None:
        """Note one time, ms >= 0."""
        self._bins[math.floor(math.log(max(ms, 1e-3), WIDTH))] += 1
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
        """Return mean, p50, p95, p99 and max in ms, ready for JSON."""
        mean = self.sum_ms / self.count if self.count else 0.0
        return {"mean_ms": mean, **{f"p{p}_ms": self.percentile(p) for p in (50, 95, 99)}, "max_ms": self.max_ms}


def peak_memory_mb() -> float | None:
    """The most memory that this process has had, in MiB; None on Windows, whose Python does not tell.

    getrusage counts in bytes on macOS and elsewhere in kibibytes (getrusage(2) of each). Linux adds to it what the
    process had that started this one, and tells the truth elsewhere.
    """
    with suppress(OSError):
        for line in STATUS.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 2**10
    if resource is None:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
