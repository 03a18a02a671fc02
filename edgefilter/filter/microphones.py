"""Which microphones of an array can be used: silent, copied, far louder ones and those that hear another echo are left out."""

from __future__ import annotations

import numpy as np

from edgefilter.types import SAMPLE_RATE, Array, Samples

BLOCK_S = 1.0
"""Over which microphones are compared; one that was left out comes back after GOOD_BLOCKS in a row without a reason."""
GOOD_BLOCKS = 3
APART = 10**1.2
"""Power over the median microphone's, 12 dB either way: equal microphones of one array agree within 1 to 2 dB, one of
another kind beside them was 12 to 18 dB louder (a real robot's noise on four microphones)."""
SILENT = 1e-6
"""Power over the median microphone's, -60 dB, below which a microphone is called silent and not soft."""
EQUAL = 1e-3
"""Part of its power by which a channel may differ from one that it is a copy of: -30 dB."""
CANCELLED, UNLIKE, LEFT = 0.1, 10.0, 0.3
"""Error over microphone where the robot is the loudest and is cancelled in the best microphone (-10 dB); how many times as
much is left in one whose path is another than was calibrated: swapped, broken, or processed; and the least of it."""


class Microphones:
    """Watches the microphones of one stream; step once a hop.

    left_out: why, by number. first: the first one that is used.

    >>> rng = np.random.default_rng(0)
    >>> watched = Microphones(3, 256)
    >>> for _ in range(62):
    ...     heard = rng.standard_normal((3, 256)).astype(np.float32)
    ...     heard[1] = 0.0
    ...     changed = watched.step(heard, heard)
    >>> changed, watched.left_out, watched.first
    (True, {1: 'silent'}, 0)
    """

    def __init__(self, count: int, hop: int) -> None:
        self.count = count
        self.left_out: dict[int, str] = {}
        self._hops = round(BLOCK_S * SAMPLE_RATE / hop)
        self._good = [GOOD_BLOCKS] * count
        self._begin()

    def _begin(self) -> None:
        self._moments = np.zeros((self.count, self.count))
        self._errors = np.zeros(self.count)
        self._seen = 0

    @property
    def first(self) -> int:
        """The one that the answer sounds like."""
        return next(at for at in range(self.count) if at not in self.left_out)

    @property
    def used(self) -> np.ndarray:
        """(count,) bool."""
        return np.array([at not in self.left_out for at in range(self.count)])

    def step(self, mic: Samples, error: Samples) -> bool:
        """Take a hop of the microphones and of the linear stage's errors (count, hop); whether others are used from now on."""
        self._moments += mic @ mic.T
        self._errors += np.einsum("ch,ch->c", error, error)
        self._seen += 1
        if self._seen < self._hops:
            return False
        reasons = self._reasons(self._moments.diagonal().copy())
        self._begin()
        before = set(self.left_out)
        for at in range(self.count):
            self._good[at] = 0 if at in reasons else self._good[at] + 1
            if at in reasons:
                self.left_out[at] = reasons[at]
            elif self._good[at] >= GOOD_BLOCKS:
                self.left_out.pop(at, None)
        if len(self.left_out) == self.count:  # then nothing can be told
            self.left_out.clear()
        return set(self.left_out) != before

    def _reasons(self, power: Array) -> dict[int, str]:
        """Why microphones of that power in the latest block should be left out."""
        reasons: dict[int, str] = {}
        median = float(np.median(power)) if self.count > 2 else float(power.max())
        for at in range(self.count) if median > 0.0 else ():
            if power[at] < SILENT * median:
                reasons[at] = "silent"
            elif not median / APART < power[at] < APART * median:
                apart = f"{abs(10 * np.log10(power[at] / median)):.0f} dB"
                reasons[at] = f"{apart} {'louder' if power[at] > median else 'softer'} than the others"
        for at in range(self.count):
            for other in range(at):
                differ = power[at] + power[other] - 2.0 * self._moments[at, other]
                if at not in reasons and other not in reasons and power[at] > 0.0 and differ < EQUAL * power[at]:
                    reasons[at] = f"the same as channel {other}"
        left = {at: self._errors[at] / power[at] for at in range(self.count) if at not in reasons and power[at] > 0.0}
        least = min(left.values(), default=1.0)
        for at in left if least < CANCELLED else ():
            if left[at] > max(UNLIKE * least, LEFT):
                reasons[at] = "hears the robot otherwise than it was calibrated, or than the others"
        return reasons
