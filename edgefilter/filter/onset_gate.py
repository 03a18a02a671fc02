"""Keeps the robot's first sounds out while the lag of its utterance is not known yet."""

from __future__ import annotations

import numpy as np

from edgefilter.alignment.delay_line import UNLOCATED, Aligned
from edgefilter.alignment.utterances import Sustained
from edgefilter.types import SAMPLE_RATE, Samples

GATE = 0.003
"""Gain while the gate is shut, -50 dB: what is left of a robot that is 20-26 dB above the human no network takes for
somebody, and the human was inaudible anyway."""
LOUD, EXPLAINED = 0.05, 100.0
"""Microphone power over the loudest that the robot has brought there from which on it can only be the robot, 7 to 13 dB
above a human 20-26 dB below; and over what the reference brings at the present delay, from which on that delay does not
explain it: single sounds pass a room 10 dB better than speech does."""
LONGEST = SAMPLE_RATE // 4
"""Samples for which the gate stays shut at most: a human as loud as the robot, beside a muted loudspeaker, loses no
more per utterance."""
USUAL, FORGET = 1e-2, 0.1 ** (1 / (10 * SAMPLE_RATE))
"""Mean square that the loudest hop of a voice is taken to have at first (-20 dB of full scale), so that a soft first
sound makes nobody else loud; and its decay per sample of speech, 10 dB in 10 s, since the volume may have been
turned."""
LEARNING = 0.1
"""Share of a loud hop in the running gain from the reference to the microphone."""
SETTLE = SAMPLE_RATE // 4
"""Samples after a lag was found in which a network, which had the robot without its reference until then, still takes
it for a human."""
RAMP = 64
"""Samples, 4 ms, over which the gate opens; it shuts at once, and what frames still hold of the hop before with it."""


class OnsetGate:
    """Lowers the microphone where it holds the robot at a delay that the aligner is still looking for.

    hop: samples per step. gain: power at the microphone over the reference's, by the profile; it is followed while the
    delay is known. shuts: whether it was open in the hop before; what came just before was the first of the robot, and
    goes with it.
    """

    def __init__(self, hop: int, gain: float) -> None:
        self._hop = hop
        self._gain = gain
        self._decay = FORGET**hop
        self._sustained = Sustained()
        self._loudest = USUAL * hop
        self._shut = self._settling = 0
        self._closed = np.full(hop, GATE, np.float32)
        self._opening = np.ones(hop, np.float32)
        ramp = min(RAMP, hop)
        self._opening[:ramp] = GATE + (1.0 - GATE) * (np.arange(ramp) + 1) / ramp
        self.shuts = False

    @property
    def suspect(self) -> bool:
        """Whether what sounds like a human may well be the robot: the gate is shut, or the lag was found a moment ago."""
        return self.shut or self._settling > 0

    @property
    def shut(self) -> bool:
        """Whether the last hop could only be the robot."""
        return 0 < self._shut <= LONGEST

    def step(self, mic: Samples, ref: Samples, aligned: Aligned) -> Samples | None:
        """Gain (hop,) for this hop of mic and of all that is made of it, None for 1. ref: (hop,) as it was played.

        aligned: what the aligner made of both.
        """
        self._settling = SETTLE if aligned.realigned else self._settling - self._hop
        heard, played, explained = (
            float(mic.dot(mic)),
            float(ref.dot(ref)),
            float(aligned.reference.dot(aligned.reference)),
        )
        sustained = self._sustained.step(played)
        if played > 1e-3 * self._loudest:
            self._loudest = max(sustained, self._decay * self._loudest)
        before = self.shut
        if aligned.state not in UNLOCATED:
            self._shut = 0
            if aligned.state == "locked" and explained > 0.1 * self._loudest:
                self._gain += LEARNING * (min(heard / explained, 2 * self._gain) - self._gain)
        elif self._shut or self._alone(heard, explained):
            self._shut += self._hop
        self.shuts = self.shut and not before
        if self.shut:
            return self._closed
        return self._opening if before else None

    def _alone(self, heard: float, explained: float) -> bool:
        """Whether a hop of this power can only be the robot, and not at the present delay."""
        return heard > LOUD * self._gain * self._loudest and heard > EXPLAINED * self._gain * explained
