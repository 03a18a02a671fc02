"""Which of two paths predicts unseen hops better."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from edgefilter.filter.echo_path import EchoPath
from edgefilter.filter.learner import FilteredHop
from edgefilter.learning.history import emphasised
from edgefilter.types import EventKind

BLOCK = 6
"""Audible hops, 96 ms, whose errors are compared as one."""
LEAST, MOST = 8, 60
"""Blocks after which a rival can win, and after which one that has not won is given up."""
GAIN_DB, CERTAIN = 0.15, 2.5
"""Mean fall of the error, and how many of its standard errors that must be."""


@dataclass
class Rival:
    """A path that is compared, hop by hop, with the one in use.

    was: what to call it. kind: of the event where it wins. stays: whether it is a standing one, compared by its latest
    1.5 s, since what was right a minute ago does not count, and never given up. gains_db: (blocks,) by how much less it left.
    """

    path: EchoPath
    was: str
    kind: EventKind = "learned"
    stays: bool = False
    gains_db: list[float] = field(default_factory=list)
    _count: int = 0
    _its: float = 1e-12
    _running: float = 1e-12

    def step(self, hop: FilteredHop, running: float, audible: bool) -> None:
        """Step it through a hop, too. running: power, emphasised, of what the path in use left of the hop."""
        left = emphasised(self.path.step(hop.mic, hop.reference, hop.located, hop.past).innovation)
        if not audible:
            return
        self._its, self._running, self._count = self._its + left, self._running + running, self._count + 1
        if self._count == BLOCK:
            self.gains_db.append(10.0 * math.log10(self._running / self._its))
            self._its, self._running, self._count = 1e-12, 1e-12, 0
            if self.stays:
                del self.gains_db[: -2 * LEAST]

    def restart(self) -> None:
        """Another path is in use now: the comparisons so far say nothing any more."""
        self.gains_db.clear()
        self._its, self._running, self._count = 1e-12, 1e-12, 0

    @property
    def gain_db(self) -> float:
        """Mean of the gains, of which there must be one."""
        return float(np.mean(self.gains_db))

    @property
    def won(self) -> bool:
        """Whether it is clearly the better one."""
        count = len(self.gains_db)
        if count < LEAST or self.gain_db < GAIN_DB:
            return False
        return self.gain_db > CERTAIN * float(np.std(self.gains_db, ddof=1)) / math.sqrt(count)

    @property
    def over(self) -> bool:
        """Whether it had its time."""
        return not self.stays and len(self.gains_db) >= MOST
