"""Mutes the robot's first sounds while the lag of its utterance is not known yet."""

from __future__ import annotations

import numpy as np

from edgefilter.alignment.delay_line import UNLOCATED, Aligned
from edgefilter.alignment.utterances import Sustained
from edgefilter.filter.volume import FORGET_S, PART
from edgefilter.types import SAMPLE_RATE, Samples

GATE = 0.003
"""Gain while the gate is shut, -50 dB: no network takes the rest of a robot that was 20-26 dB above the human for a human,
and the human was inaudible anyway."""
LOUD, EXPLAINED = 0.05, 100.0
"""LOUD: microphone power, over the robot's loudest there, from which on it can only be the robot; a human 20-26 dB below
the robot is 7 to 13 dB softer. EXPLAINED: microphone power, over that of the echo at the present delay, from which on this
delay is not the right one; single sounds pass a room up to 10 dB better than speech does."""
LONGEST = SAMPLE_RATE // 4
"""Samples for which the gate stays shut at most: a human as loud as the robot, beside a muted loudspeaker, loses no
more per utterance."""
USUAL = 1e-2
"""Mean square that the loudest hop of a voice is taken to have at first (-20 dB of full scale), so that a soft first
sound makes nobody else loud; it fades as the echo's peak does (volume.py), since the volume may have been turned."""
LEARNING = 0.1
"""Share of a loud hop in the running gain from the reference to the microphone."""
SETTLE = SAMPLE_RATE // 4
"""Samples after a lag was found in which a network still takes the robot for a human: it had no reference until then."""


class OnsetGate:
    """Lowers the microphone while it holds the robot at a delay that the aligner is still looking for.

    hop: samples per step. gain: power at the microphone over the reference's, from the profile; it is followed while the
    delay is known. shuts: whether the gate shut with the latest hop, so that the hop before is to be lowered as well.
    """

    def __init__(self, hop: int, gain: float) -> None:
        self._hop = hop
        self._gain = gain
        self._decay = 0.1 ** (hop / (FORGET_S * SAMPLE_RATE))
        self._sustained = Sustained()
        self._loudest, self._least = 0.0, USUAL * hop
        self._shut = self._settling = 0
        self._closed = np.full(hop, GATE, np.float32)
        self._opening = np.ones(hop, np.float32)
        ramp = min(PART, hop)  # the gate opens over 4 ms, and shuts at once
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
        """The gain (hop,) for this hop of mic and of all signals made of it; None stands for 1. ref: (hop,) as it was played.

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
                self._least = 0.0  # how loud this voice is, is known from now on
                self._gain += LEARNING * (min(heard / explained, 2 * self._gain) - self._gain)
        elif self._shut or self._alone(heard, explained):
            self._shut += self._hop
        self.shuts = self.shut and not before
        if self.shut:
            return self._closed
        return self._opening if before else None

    def _alone(self, heard: float, explained: float) -> bool:
        """Whether a hop of this power can only be the robot, and not at the present delay."""
        return (
            heard > LOUD * self._gain * max(self._loudest, self._least) and heard > EXPLAINED * self._gain * explained
        )
