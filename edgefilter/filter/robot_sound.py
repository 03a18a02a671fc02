"""What the robot sounds like at the microphone: level and colour, by which it is known again when no reference tells of it."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.psd import mel_edges
from edgefilter.filter.volume import AUDIBLE
from edgefilter.types import SAMPLE_RATE, Samples

BANDS, LOWEST_HZ = 20, 100.0
"""Bands as wide as the ear's (mel), and where the lowest begins."""
HEARD_S = 4.0
"""Seconds of robot from which on its sound is known, and of another sound that are compared with it."""
MEMORY_S = 20.0
"""Seconds of robot over which its sound is averaged."""
NOISY = 4.0
"""Power over the noise's, 6 dB, from which on a band is compared."""
ALIKE_DB = 4.5
"""Root mean square, over the bands, of the difference in level below which a sound is taken for the robot. On 18 real devices
8 of 10 stretches of 4 s of robot differ by less from the others; of 108 of humans who were brought to the robot's level
none does (least 5.0 dB)."""


class RobotSound:
    """Mean power of the robot at the microphone in bands of its spectrum, and of what is heard without a reference.

    hop: samples per step. bins: of a spectrum.
    """

    def __init__(self, hop: int, bins: int) -> None:
        self._edges = mel_edges(bins, BANDS, LOWEST_HZ)
        self._enough, self._most = (round(s * SAMPLE_RATE / hop) for s in (HEARD_S, MEMORY_S))
        self._robot = np.zeros(self._edges.size)
        self._hops = 0
        self.forget()

    def forget(self) -> None:
        """Begin anew with what is heard."""
        self._other, self._count = np.zeros(self._edges.size), 0

    def learn(self, power: Samples) -> None:
        """Take in a hop of the robot: power of the microphone's spectrum (bins,)."""
        self._hops += 1
        self._robot += (np.add.reduceat(power, self._edges) - self._robot) / min(self._hops, self._most)

    def compare(self, power: Samples, noise: Samples) -> bool | None:
        """Take in a hop without a reference; every HEARD_S of sound whether it is the robot, else None. power, noise: (bins,)."""
        if self._hops < self._enough:
            return None
        heard = np.add.reduceat(power, self._edges)
        if heard.sum() < AUDIBLE * self._robot.sum():
            return None
        self._other += heard
        self._count += 1
        if self._count < self._enough:
            return None
        other, floor = self._other / self._count, np.add.reduceat(noise, self._edges)
        self.forget()
        compared = np.maximum(other, self._robot) > NOISY * floor
        level_db = 10.0 * np.log10((other + floor) / (self._robot + floor + 1e-30))
        return bool(compared.any() and np.sqrt(np.mean(np.square(level_db[compared]))) < ALIKE_DB)
