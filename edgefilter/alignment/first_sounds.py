"""The first sounds of an utterance of the robot, which arrive before its lag is found."""

from __future__ import annotations

import numpy as np

from edgefilter.types import SAMPLE_RATE, AlignmentState, Samples

LOUD, EXPLAINED = 0.05, 100.0
"""LOUD: microphone power, over the robot's loudest there, from which on it can only be the robot; a human 20-26 dB below
the robot is 7 to 13 dB softer. EXPLAINED: microphone power, over that of the echo at the present delay, from which on this
delay is not the right one; single sounds pass a room up to 10 dB better than speech does."""
LONGEST = SAMPLE_RATE // 4
"""Samples for which that is believed at most once the robot was heard: a human as loud as the robot, who begins as its next
utterance does, loses no more."""
USUAL = 1e-2
"""Mean square that the loudest hop of a voice is taken to have at first (-20 dB of full scale), so that a soft first
sound makes nobody else loud."""
LEARNING = 0.1
"""Share of a loud hop in the running gain from the reference to the microphone."""


class FirstSounds:
    """Tells, by its level, whether the microphone holds a calibrated robot at another delay than the present one.

    hop: samples per step. response: (taps,), calibrated impulse response from the reference to the microphone.
    """

    def __init__(self, hop: int, response: Samples) -> None:
        self._hop = hop
        self._calibrated = float(np.sum(np.square(response)))
        self.reset()

    def reset(self) -> None:
        """As before the first hop."""
        self._gain, self._heard, self._since = self._calibrated, False, 0

    def step(self, mic: Samples, explained: Samples, loudest: float, state: AlignmentState, waits: bool) -> bool:
        """Take a hop of the microphone and of the reference at the present delay, zeros where there is none, (hop,) each.

        loudest: mean square of the reference's loudest hop. waits: whether there is an utterance that was not found yet.
        """
        power, brought = float(np.dot(mic, mic)), float(np.dot(explained, explained))
        if state == "locked" and brought > 0.1 * self._hop * loudest:
            self._heard = True
            self._gain += LEARNING * (min(power / brought, 2.0 * self._gain) - self._gain)
        if not waits:
            self._since = 0
            return False
        least = LOUD * self._hop * (loudest if self._heard else max(loudest, USUAL))
        if self._since or power > self._gain * max(least, EXPLAINED * brought):
            self._since += self._hop
        return 0 < self._since <= (LONGEST if self._heard else np.inf)
