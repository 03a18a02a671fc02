"""Sound that should have come by the clock and did not: a driver, a machine that slept or a closed microphone lost it."""

from __future__ import annotations

import math
from collections import deque

TOLERANCE_S = 0.01
"""Seconds of delay that come and go with the phase of callbacks."""
LEAST_LOOK = 0.1
"""Part of look_s that is waited at least: what stood still finds everything else waiting, and is on time at once."""
DRIFT = 5e-4
"""Largest difference of two clocks: by so much a delay may grow without a loss."""


class SampleClock:
    """Compares what a source has delivered with the clock.

    Late sound catches up, lost sound does not: a delay that has grown counts as a loss once it was never smaller for a
    while, look_s for a small one, and shorter the nearer it is to stall_s, which no source stands still before it delivers
    all. What comes after all is taken off again. missed: seconds lost so far.

    >>> clock = SampleClock(0.1)
    >>> [round(clock.note(now - 0.2 * (now > 1.0), now), 3) for now in (0.0, 0.5, 1.0, 1.5, 1.6)]
    [0.0, 0.0, 0.0, 0.0, 0.2]
    """

    def __init__(self, look_s: float, stall_s: float = math.inf) -> None:
        self.missed = self.doubt_s = 0.0
        self._look_s, self._stall_s = look_s, stall_s
        self._usual: float | None = None
        self._seen: deque[tuple[float, float]] = deque()

    def note(self, delivered_s: float, now: float) -> float:
        """Take note of the seconds of sound that came so far, when no more is waiting; by how much `missed` has grown."""
        delay = now - delivered_s
        if self._usual is None:
            self._usual = delay
        elif self._seen and delay < self._usual + TOLERANCE_S:
            self._usual += min(DRIFT * (now - self._seen[-1][0]), max(delay - self._usual, 0.0))
        self._seen.append((now, delay))
        while self._seen[0][0] < now - self._look_s - 1e-9:
            self._seen.popleft()
        if delay < self._usual:
            return self._take_off(delay)
        least, self.doubt_s = delay, 0.0
        for at, each in reversed(self._seen):
            least = min(least, each)
            grown = least - self._usual
            if grown <= TOLERANCE_S:
                break
            if now - at >= self._look_s * max(1.0 - grown / self._stall_s, LEAST_LOOK) - 1e-9:
                self._usual, self.missed, self.doubt_s = least, self.missed + grown, 0.0
                return grown
            self.doubt_s = delay - self._usual
        return 0.0

    def _take_off(self, delay: float) -> float:
        """The delay is shorter than it usually is: that much has come after all."""
        found = min(self._usual - delay, self.missed) if self._usual is not None else 0.0
        self._usual, self.doubt_s = delay, 0.0
        if found <= TOLERANCE_S:
            return 0.0
        self.missed -= found
        return -found
