"""Which of two paths predicts better what neither has heard yet."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from edgefilter.filter.echo_path import EchoPath
from edgefilter.filter.learner import Heard
from edgefilter.learning.tape import emphasised
from edgefilter.types import EventKind

BLOCK = 6
"""Audible hops, 96 ms, whose errors are compared as one."""
LEAST, MOST = 8, 60
"""Blocks after which a verdict is possible, and after which a rival that has not won is given up."""
LATEST = 16
"""Blocks, 1.5 s, by which one is judged that is never given up: what was right a minute ago does not count."""
GAIN_DB, CERTAIN = 0.15, 2.5
"""Mean fall of the error, and how many of its standard errors that must be."""


@dataclass
class Rival:
    """A path that runs beside the one in use and wants its place.

    was: what to call it. kind: of the event where it wins. stays: whether it is a standing one, judged by its latest
    blocks and never given up. gains_db: (blocks,) by how much less it left.
    """

    path: EchoPath
    was: str
    kind: EventKind = "learned"
    stays: bool = False
    gains_db: list[float] = field(default_factory=list)
    _count: int = 0
    _its: float = 1e-12
    _running: float = 1e-12

    def step(self, heard: Heard, running: float, audible: bool) -> None:
        """Let it hear a hop too. running: power, emphasised, of what the path in use left of it."""
        left = emphasised(self.path.step(heard.mic, heard.reference, heard.located, heard.past).innovation)
        if not audible:
            return
        self._its, self._running, self._count = self._its + left, self._running + running, self._count + 1
        if self._count == BLOCK:
            self.gains_db.append(10.0 * math.log10(self._running / self._its))
            self._its, self._running, self._count = 1e-12, 1e-12, 0
            if self.stays:
                del self.gains_db[:-LATEST]

    def forget(self) -> None:
        """The path in use is another one: what was compared so far says nothing any more."""
        self.gains_db.clear()
        self._its, self._running, self._count = 1e-12, 1e-12, 0

    @property
    def gain_db(self) -> float:
        """Mean of the gains."""
        return float(np.mean(self.gains_db)) if self.gains_db else 0.0

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
