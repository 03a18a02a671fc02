"""Keeps the robot's first sounds out while the lag of its utterance is not known yet."""

from __future__ import annotations

import numpy as np

from edgefilter.alignment.delay_line import Aligned
from edgefilter.types import SAMPLE_RATE, Samples

GATE = 0.003
"""Gain while the gate is shut, -50 dB: what is left of a robot that is 20-26 dB above the human no network takes for somebody, and
the human was inaudible anyway."""
LOUD, EXPLAINED = 0.05, 100.0
"""Microphone power over the loudest that the robot has brought there from which on it can only be the robot, 7 to 13 dB above a human
20-26 dB below; and over what the reference brings at the present delay, from which on that delay does not explain it: single sounds
pass a room 10 dB better than speech does."""
LONGEST = SAMPLE_RATE // 4
"""Samples for which the gate stays shut at most: a human as loud as the robot, beside a muted loudspeaker, loses no more per utterance."""
USUAL, FORGET = 1e-2, 0.1 ** (1 / (10 * SAMPLE_RATE))
"""Mean square that the loudest hop of a voice is taken to have at first (-20 dB of full scale), so that a soft first sound makes nobody
else loud; and its decay per sample of speech, 10 dB in 10 s, since the volume may have been turned."""
LEARNING = 0.1
"""Share of a loud hop in the running gain from the reference to the microphone."""
SETTLE = SAMPLE_RATE // 4
"""Samples after a lag was found in which a network, which had the robot without its reference until then, still takes it for a human."""
RAMP = 64
"""Samples, 4 ms, over which the gate opens and shuts."""


class OnsetGate:
    """Lowers the microphone where it holds the robot at a delay that the aligner is still looking for.

    hop: samples per step. gain: power at the microphone over the reference's, None if there is no profile; then the gate learns it
    while the delay is known, and until then it stays open.
    """

    def __init__(self, hop: int, gain: float | None = None) -> None:
        self._hop = hop
        self._gain = gain
        self._decay = FORGET**hop
        self._loudest = USUAL * hop
        self._shut = self._settling = 0
        self._last = 1.0
        self._rise = (np.arange(RAMP, dtype=np.float32) + 1) / RAMP

    @property
    def suspect(self) -> bool:
        """Whether what sounds like a human may well be the robot: the gate is shut, or the lag was found a moment ago."""
        return self.shut or self._settling > 0

    @property
    def shut(self) -> bool:
        """Whether the last hop could only be the robot."""
        return 0 < self._shut <= LONGEST

    def step(self, mic: Samples, ref: Samples, aligned: Aligned) -> Samples:
        """mic (hop,) as it is, or with the robot lowered. ref: (hop,) as it was played. aligned: what the aligner made of both."""
        self._settling = SETTLE if aligned.realigned else self._settling - self._hop
        heard, played, explained = float(mic.dot(mic)), float(ref.dot(ref)), float(aligned.reference.dot(aligned.reference))
        if played > 1e-3 * self._loudest:
            self._loudest = max(played, self._decay * self._loudest)
        if aligned.state != "searching":
            self._shut = 0
            if aligned.state == "locked" and explained > 0.1 * self._loudest:
                now = heard / explained
                self._gain = now if self._gain is None else self._gain + LEARNING * (min(now, 2 * self._gain) - self._gain)
            return self._apply(mic, 1.0)
        if not self._shut and not self._alone(heard, explained):
            return mic
        self._shut += self._hop
        return self._apply(mic, GATE if self.shut else 1.0)

    def _alone(self, heard: float, explained: float) -> bool:
        """Whether a hop of this power can only be the robot, and not at the present delay."""
        if self._gain is None:
            return False
        return heard > LOUD * self._gain * self._loudest and heard > EXPLAINED * self._gain * explained

    def _apply(self, mic: Samples, gain: float) -> Samples:
        if gain == self._last == 1.0:
            return mic
        out = gain * mic
        edge = min(RAMP, mic.size)
        out[:edge] = (self._last + (gain - self._last) * self._rise[:edge]) * mic[:edge]
        self._last = gain
        return out
