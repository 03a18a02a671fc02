"""Sound that should have come by the clock and did not: a driver, a machine that slept or a closed microphone lost it."""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass

from edgefilter.types import expect_positive


@dataclass(frozen=True)
class Lateness:
    """When sound that is late counts as lost; seconds of delay or of waiting. Raises UsageError for what cannot be."""

    look_s: float = 0.15
    """How long a small delay must last to count as lost sound: longer than the pause between packets of 100 ms."""
    stall_s: float = 0.25
    """A delay of so much counts after `least_look` of look_s: a program that had stalled for so long would have read all that waited."""
    held_s: float = 0.1
    """How late a block must be for its samples to be held back until it is clear whether some were lost."""
    tolerance_s: float = 0.01
    """Delay that comes and goes with the phase of callbacks."""
    least_look: float = 0.1
    """Least part of look_s for which a delay must last, however large: a program that stalled is on time again at its next call."""
    drift: float = 5e-4
    """Largest difference of two clocks: by so much a delay may grow without a loss."""

    def __post_init__(self) -> None:
        expect_positive({name: value for name, value in asdict(self).items() if name != "look_s" or value != 0})


class SampleClock:
    """Compares what a source has delivered with the clock.

    Late sound catches up, lost sound does not: a delay that has grown counts as a loss once it has not shrunk for look_s, or
    for less the nearer it is to stall_s. Sound that arrives after all is subtracted again. missed: seconds lost so far.
    drifted: further seconds by which the source's clock has fallen behind. doubt_s: delay that may still prove a loss.

    >>> clock = SampleClock()
    >>> [round(clock.note(now - 0.2 * (now > 1.0), now), 3) for now in (0.0, 0.5, 1.0, 1.1, 1.2)]
    [0.0, 0.0, 0.0, 0.0, 0.2]
    """

    def __init__(self, lateness: Lateness = Lateness()) -> None:
        self.missed = self.drifted = 0.0
        self._lateness = lateness
        self.restart()

    def restart(self) -> None:
        """Begin again with a source that counts anew."""
        self.doubt_s = 0.0
        self._usual: float | None = None
        self._seen: deque[tuple[float, float]] = deque()

    @property
    def doubts(self) -> bool:
        """Whether so much is late that it is not clear yet what was lost."""
        return self.doubt_s > self._lateness.held_s

    def note(self, delivered_s: float, now: float) -> float:
        """Take note of how many seconds of sound have come so far, all of them taken; return by how many seconds `missed` has grown."""
        delay, late = now - delivered_s, self._lateness
        if self._usual is None:
            self._usual = delay
        elif self._seen and delay < self._usual + late.tolerance_s:
            drift = min(late.drift * (now - self._seen[-1][0]), max(delay - self._usual, 0.0))
            self._usual, self.drifted = self._usual + drift, self.drifted + drift
        self._seen.append((now, delay))
        while self._seen[0][0] < now - late.look_s - 1e-9:
            self._seen.popleft()
        if delay < self._usual:
            # what has come after all, or a clock that is fast
            sooner, self._usual, self.doubt_s = self._usual - delay, delay, 0.0
            found = min(sooner, self.missed)
            if found > late.tolerance_s:
                self.missed -= found
                return -found
            self.drifted -= sooner if sooner <= late.tolerance_s else 0.0
            return 0.0
        least, self.doubt_s = delay, 0.0
        for at, each in reversed(self._seen):
            least = min(least, each)
            grown = least - self._usual
            if grown <= late.tolerance_s:
                break
            if now - at >= late.look_s * max(1.0 - grown / late.stall_s, late.least_look) - 1e-9:
                self._usual, self.missed, self.doubt_s = least, self.missed + grown, 0.0
                return grown
            self.doubt_s = delay - self._usual
        return 0.0
