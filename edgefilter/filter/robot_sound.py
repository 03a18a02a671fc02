"""What the robot sounds like at the microphone: the shape of its spectrum, by which it is known again without a reference."""

from __future__ import annotations

import numpy as np

from edgefilter.alignment.coarse_lag import BANDS
from edgefilter.dsp.lag import LOWEST_HZ
from edgefilter.dsp.psd import mel_edges
from edgefilter.filter.volume import AUDIBLE
from edgefilter.types import SAMPLE_RATE, Samples

HEARD_S = 4.0
"""Seconds of robot from which on its sound is known, and of another sound that are compared with it."""
MEMORY_S = 20.0
"""Seconds of robot, and of another sound, over which either is averaged."""
NOISY = 4.0
"""Power over the noise's, 6 dB, from which on a band is compared."""
ALIKE_DB = 3.7
"""dB. A sound whose levels in bands differ from the robot's by a smaller standard deviation is taken for the robot, however loud it is. On
25 real devices two thirds of the stretches of 4 s of robot differ by less from the device's other stretches. Of 664 stretches of
humans 5.7 % are below 5.4 dB and one below 4.4 dB: extrapolated, one in 8000 is below this."""


class RobotSound:
    """Mean power of the robot at the microphone in bands of its spectrum, and of what is heard without a reference.

    hop: samples per step. bins: of a spectrum.
    """

    def __init__(self, hop: int, bins: int) -> None:
        # bands half as wide as the ear's; with 20, as wide as those, 25 times as many humans pass
        self._edges = mel_edges(bins, BANDS, LOWEST_HZ)
        self._enough, self._most = (round(s * SAMPLE_RATE / hop) for s in (HEARD_S, MEMORY_S))
        self._robot = np.zeros(self._edges.size)
        self._hops = 0
        self.forget()

    def forget(self) -> None:
        """The reference plays again: forget what was heard while it was silent."""
        self._other, self._count = np.zeros(self._edges.size), 0

    def learn(self, power: Samples) -> None:
        """Take in a hop of the robot: power of the microphone's spectrum (bins,)."""
        self._hops += 1
        self._robot += (np.add.reduceat(power, self._edges) - self._robot) / min(self._hops, self._most)

    def compare(self, power: Samples, noise: Samples) -> bool | None:
        """Take in a hop without a reference; every HEARD_S of sound whether all since `forget` is the robot, else None. power, noise: (bins,)."""
        if self._hops < self._enough:
            return None
        heard = np.add.reduceat(power, self._edges)
        if heard.sum() < AUDIBLE * self._robot.sum():
            return None
        self._count += 1
        self._other += (heard - self._other) / min(self._count, self._most)
        if self._count % self._enough:
            return None
        other, floor = self._other, np.add.reduceat(noise, self._edges)
        compared = np.maximum(other, self._robot) > NOISY * floor
        level_db = 10.0 * np.log10((other + floor) / (self._robot + floor + 1e-30))
        return bool(compared.any() and level_db[compared].std() < ALIKE_DB)
