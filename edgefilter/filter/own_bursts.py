"""How often the robot itself sounds like somebody for a moment: what its loudspeaker leaves of some voices does."""

from __future__ import annotations

from collections import deque

BURST_S = 0.35
"""What lasts longer is somebody who speaks: of humans who interrupt nine in ten last 0.42 s at once, of a robot's bursts
nine in ten are over after 0.34 s (both at 3.25 averaged log-odds)."""
GAP_S = 0.064
"""What comes back sooner goes on."""
ALONE_S = 1.0
"""A burst so near to somebody's speech is theirs: the end of a word, a soft syllable."""
MEMORY_S = 10.0
"""Of the rate of bursts, seconds of the robot's speech."""
FEW, MANY = 0.08, 0.3
"""Bursts a second of the robot's speech up to which nothing is made of them, and from which on all: voices that the network
knows have up to 0.05, also while somebody interrupts them, those that it takes for humans 0.4 to 1.1."""


class OwnBursts:
    """Counts, in one stream, the moments in which the robot was taken for somebody; step once a frame.

    hop_s: seconds between two frames. level: averaged log-odds above which somebody may be speaking.

    A constant rate of false alarms, which a threshold that is learned from what it shall not notice would give, is not
    what is wanted here: somebody who interrupts again and again would be learned as well. Only what is over too soon for
    a word, with nobody speaking for a second before and after it, counts.

    >>> robot = OwnBursts(0.016, 3.0)
    >>> alone = [robot.step(5.0 if hop % 60 < 5 else -2.0, robot=True) for hop in range(1500)]
    >>> alone[0], alone[-1]
    (0.0, 1.0)
    >>> talked_to = OwnBursts(0.016, 3.0)
    >>> max(talked_to.step(5.0 if hop % 60 < 40 else -2.0, robot=True) for hop in range(1500))
    0.0
    """

    def __init__(self, hop_s: float, level: float) -> None:
        self._hop_s, self._level = hop_s, level
        self._now = self._length = 0.0
        self._last = self._human = -ALONE_S
        self._rate, self._keep = 0.0, 1.0 - hop_s / MEMORY_S
        self._waiting: deque[float] = deque()

    def step(self, odds: float, robot: bool) -> float:
        """How much is to be doubted, 0 to 1, that a moment's odds are somebody's; robot: whether it can be heard in the frame."""
        self._now += self._hop_s
        silent = self._now - self._last
        if robot:
            self._rate *= self._keep
        if robot and odds > self._level:
            self._length += silent if self._length else self._hop_s
            self._last = self._now
            if self._length > BURST_S:
                self._human = self._now
                self._waiting.clear()
        elif self._length and silent > GAP_S:
            if self._length <= BURST_S and self._now - self._human > ALONE_S:
                self._waiting.append(self._now)
            self._length = 0.0
        while self._waiting and self._now - self._waiting[0] > ALONE_S:
            self._waiting.popleft()
            self._rate += 1.0 / MEMORY_S
        return min(max((self._rate - FEW) / (MANY - FEW), 0.0), 1.0)
