"""The last minute of hops: the microphone with the reference as the aligner delivered it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edgefilter.filter.echo_path import TAPS, EchoPath, FilteredHop
from edgefilter.filter.volume import pre_emphasised
from edgefilter.types import SAMPLE_RATE, Samples

NOTHING_LEARNED = {"rounds": 0, "learned": 0, "unlearned": 0, "remembered": 0, "heard_s": 0.0}
"""What learning counts before it has begun: rounds of fits, paths taken over, given up again, and written to the file; seconds of robot."""
MINUTE = 60.0
"""Seconds that are kept."""
RECENT_S = 15.0
"""Seconds of the newest sound among them: enough to fit a loudspeaker and a room to, and as a rule all from where the robot stands now."""


class HopHistory:
    """Keeps a minute of hops of `hop` samples, and whether the robot was audible in each. count: of all hops so far."""

    def __init__(self, hop: int) -> None:
        self._hop = hop
        self.count = 0
        self._hops: list[tuple[FilteredHop, bool]] = []

    def append(self, hop: FilteredHop, audible: bool) -> None:
        """Take one hop; now and then the oldest ones are dropped."""
        self._hops.append((hop._replace(mic=hop.mic.copy()), audible))
        self.count += 1
        most = self._hops_of(MINUTE)
        if len(self._hops) > most + most // 4:
            del self._hops[:-most]

    def since(self, count: int) -> Sequence[tuple[FilteredHop, bool]]:
        """The hops after the first `count` of all, at most RECENT_S of them; each with whether the robot was audible."""
        return self._hops[max(0, len(self._hops) - min(self.count - count, self._hops_of(RECENT_S))) :]

    def recent(self) -> HopHistory:
        """Its newest RECENT_S."""
        newest = HopHistory(self._hop)
        newest._hops = self._hops[-self._hops_of(RECENT_S) :]
        return newest

    def replay(self, path: EchoPath) -> None:
        """Step a path through all of it, as the running filter was stepped."""
        for hop, _ in self._hops:
            path.step(hop.mic, hop.reference, hop.located, hop.past)

    def signal(self, name: str) -> Samples:
        """Microphone, reference or innovation, by its name in FilteredHop, (n,); of an array the first microphone."""
        rows = (getattr(hop, name) for hop, _ in self._hops)
        return np.concatenate([row if row.ndim == 1 else row[0] for row in rows])

    def noise(self) -> Samples:
        """Recording of an array where nothing of the robot can be audible, everything where that is under a second, (microphones, n)."""
        silent = [hop.mic for hop, _ in self._hops if hop.idle]
        enough = len(silent) > self._hops_of(1.0)
        return np.concatenate(silent if enough else [hop.mic for hop, _ in self._hops], axis=-1)

    def usable(self) -> NDArray[np.bool_]:
        """Where the robot may be audible and the reference lies as the microphone hears it, (n,) bool."""
        usable = np.array([hop.located and not hop.idle for hop, _ in self._hops])
        # for the length of a path after a switch of the delay some of the echo was sent under the delay of before
        for at in np.flatnonzero([hop.past is not None for hop, _ in self._hops]):
            usable[at : at + TAPS[1] // self._hop] = False
        return np.repeat(usable, self._hop)

    def silent(self) -> NDArray[np.bool_]:
        """Where nothing of the robot can be audible, (n,) bool."""
        return np.repeat(np.array([hop.idle for hop, _ in self._hops]), self._hop)

    @property
    def delay(self) -> float:
        """Samples, the latest that is known; 0 where none is."""
        return next((hop.delay for hop, _ in reversed(self._hops) if hop.delay == hop.delay), 0.0)

    def _hops_of(self, seconds: float) -> int:
        return max(1, round(seconds * SAMPLE_RATE / self._hop))


def emphasised(x: Samples) -> float:
    """Power of x (n,), or of all microphones (microphones, n), with pre-emphasis, summed."""
    bright = pre_emphasised(x)
    return float(np.vdot(bright, bright))
