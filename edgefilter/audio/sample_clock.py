"""Sound that should have come by the clock and did not: a driver, a machine that slept or a closed microphone lost it."""

from __future__ import annotations

from collections import deque

LOOK_S, STALL_S = 0.15, 0.25
"""How long a small delay must last to count as lost sound, longer than transports of 100 ms are quiet; and a delay that
counts after a tenth of that: a program that stood still for so long finds all that it has missed waiting."""
HELD_S = 0.1
"""Lateness of a block, seconds, from which on its samples wait until it is clear whether some were lost."""
TOLERANCE_S = 0.01
"""Seconds of delay that come and go with the phase of callbacks."""
LEAST_LOOK = 0.1
"""Part of look_s that is waited at least: what stood still finds everything else waiting, and is on time at once."""
DRIFT = 5e-4
"""Largest difference of two clocks: by so much a delay may grow without a loss."""


class SampleClock:
    """Compares what a source has delivered with the clock.

    Late sound catches up, lost sound does not: a delay that has grown counts as a loss once it was never smaller for a
    while, look_s for a small one, and shorter the nearer it is to STALL_S. What comes after all is taken off again. missed:
    seconds lost so far. drifted: seconds by which the source's clock has fallen behind besides.
    doubt_s: delay of which it is not clear yet whether it is a loss.

    >>> clock = SampleClock()
    >>> [round(clock.note(now - 0.2 * (now > 1.0), now), 3) for now in (0.0, 0.5, 1.0, 1.1, 1.2)]
    [0.0, 0.0, 0.0, 0.0, 0.2]
    """

    def __init__(self, look_s: float = LOOK_S) -> None:
        self.missed = self.drifted = 0.0
        self._look_s = look_s
        self.restart()

    def restart(self) -> None:
        """Begin again with a source that counts anew."""
        self.doubt_s = 0.0
        self._usual: float | None = None
        self._seen: deque[tuple[float, float]] = deque()

    def note(self, delivered_s: float, now: float) -> float:
        """Take note of the seconds of sound that came so far, when no more is waiting; by how much `missed` has grown."""
        delay = now - delivered_s
        if self._usual is None:
            self._usual = delay
        elif self._seen and delay < self._usual + TOLERANCE_S:
            drift = min(DRIFT * (now - self._seen[-1][0]), max(delay - self._usual, 0.0))
            self._usual, self.drifted = self._usual + drift, self.drifted + drift
        self._seen.append((now, delay))
        while self._seen[0][0] < now - self._look_s - 1e-9:
            self._seen.popleft()
        if delay < self._usual:
            # what has come after all, or a clock that is fast
            sooner, self._usual, self.doubt_s = self._usual - delay, delay, 0.0
            found = min(sooner, self.missed)
            if found > TOLERANCE_S:
                self.missed -= found
                return -found
            self.drifted -= sooner if sooner <= TOLERANCE_S else 0.0
            return 0.0
        least, self.doubt_s = delay, 0.0
        for at, each in reversed(self._seen):
            least = min(least, each)
            grown = least - self._usual
            if grown <= TOLERANCE_S:
                break
            if now - at >= self._look_s * max(1.0 - grown / STALL_S, LEAST_LOOK) - 1e-9:
                self._usual, self.missed, self.doubt_s = least, self.missed + grown, 0.0
                return grown
            self.doubt_s = delay - self._usual
        return 0.0
