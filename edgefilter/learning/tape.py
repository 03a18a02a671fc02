"""The last minute of hops, straight: the microphone beside the reference that the aligner found for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgefilter.filter.echo_path import EchoPath
from edgefilter.filter.learner import Heard
from edgefilter.types import SAMPLE_RATE, Samples

PRE_EMPHASIS = 0.95
"""First-order pre-emphasis: fan and rumble below the voice weigh less."""
UNSETTLED_S = 0.4
"""After the delay was switched, what of the echo was sent before it is on the tape under another delay."""


class Tape:
    """Keeps `seconds` of hops. hop: samples of each."""

    def __init__(self, hop: int, seconds: float) -> None:
        self._hop = hop
        self._most = max(1, round(seconds * SAMPLE_RATE / hop))
        self._hops: list[Heard] = []

    def append(self, heard: Heard) -> None:
        """Take one hop; now and then the oldest ones are dropped."""
        self._hops.append(heard._replace(mic=heard.mic.copy()))
        if len(self._hops) > self._most + self._most // 4:
            del self._hops[: -self._most]

    def replay(self, path: EchoPath, newest_s: float | None = None) -> float:
        """Let a path hear all of it, or its newest seconds, as the running filter did; the power, emphasised, that it left."""
        first = 0 if newest_s is None else max(0, len(self._hops) - round(newest_s * SAMPLE_RATE / self._hop))
        return sum(
            emphasised(path.step(heard.mic, heard.reference, heard.located, heard.past).innovation)
            for heard in self._hops[first:]
        )

    def signals(self) -> tuple[Samples, Samples, Samples]:
        """Microphone, reference and innovation, (n,) each."""
        mic, reference, innovation = (np.concatenate(rows) for rows in list(zip(*self._hops, strict=True))[:3])
        return mic, reference, innovation

    def straight(self) -> NDArray[np.bool_]:
        """(n,) bool, where the reference lies as the microphone hears it."""
        located = np.array([heard.located for heard in self._hops])
        unsettled = -(-round(UNSETTLED_S * SAMPLE_RATE) // self._hop)
        for at in np.flatnonzero([heard.past is not None for heard in self._hops]):
            located[at : at + unsettled] = False
        return np.repeat(located, self._hop)

    def silent(self) -> NDArray[np.bool_]:
        """(n,) bool, where nothing of the robot can be heard."""
        return np.repeat(np.array([heard.idle for heard in self._hops]), self._hop)

    @property
    def delay(self) -> float:
        """Samples, the latest that is known; 0 where none is."""
        return next((heard.delay for heard in reversed(self._hops) if heard.delay == heard.delay), 0.0)


def emphasised(x: Samples) -> float:
    """Power of x (n,) with pre-emphasis, summed."""
    bright = x[1:] - PRE_EMPHASIS * x[:-1]
    return float(bright.dot(bright))
