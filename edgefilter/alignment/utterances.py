"""Where the robot's utterances begin and end in the reference."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from edgefilter.types import SAMPLE_RATE, Samples

PAUSE = SAMPLE_RATE // 5
"""Samples of silence after which the lag may be another one: shorter than any pause between two playbacks, longer than
a plosive."""
FLOOR = 2.0**-46
"""Mean square of a 24-bit converter's last bit, -138 dB of full scale: a reference that has less is silent."""
RANGE = 10**-4.5
"""A hop this far (45 dB) under the loudest of the last seconds is silence."""
SUSTAINED = 3
"""Hops that a level must last to be the voice's: 48 ms, a short vowel. A click falls into two at most."""
VARIES = 10**1.5
"""A voice's loudest hop is so much louder than its softest, or than the silence before, 15 dB; those of a noise are alike."""
NEVER = -(10**9)
"""A position long before the first sample."""


@dataclass
class Utterance:
    """A stretch of speech in the reference, positions in samples; start lies up to two hops before the first sound.

    after: end of the one before it, which the microphone hears out first, since one loudspeaker plays them in turn.
    lost: whether it is one that was followed and is looked for again, not one that began; nearby: searches left that
    suppose it to have jumped a short while ago, its start moving along.
    """

    start: int
    end: int
    after: int = NEVER
    nearby: int = 0
    lost: bool = False


class Sustained:
    """How loud a voice is that may hold clicks: the level that it holds for a short vowel."""

    def __init__(self) -> None:
        self._powers = deque([0.0] * SUSTAINED, maxlen=SUSTAINED)

    def step(self, power: float) -> float:
        """Take the power of the next hop; the least of the last SUSTAINED."""
        self._powers.append(power)
        return min(self._powers)


class OnsetDetector:
    """Cuts the reference into utterances, hop by hop.

    current: the last one that began; before the first, one that ended long ago. peak, least: mean square of the loudest and of the
    softest hop of the last seconds.
    """

    def __init__(self, hop: int) -> None:
        self._hop = hop
        self._sustained = Sustained()
        self.peak, self.least = 0.0, float("inf")
        self._decay = 0.1 ** (hop / (10.0 * SAMPLE_RATE))
        self.now = 0
        self.current = Utterance(NEVER, NEVER)
        self.active = False

    @property
    def varies(self) -> bool:
        """Whether the reference varies as a voice does, and is no mere noise of a loopback."""
        return self.peak > VARIES * self.least

    def step(self, ref: Samples) -> Utterance | None:
        """Take a hop (hop,) and return the utterance that begins with it, if one does.

        `current` grows while it lasts.
        """
        self.now += self._hop
        power = float(ref.dot(ref)) / self._hop
        self.peak = max(self._sustained.step(power), self.peak * self._decay)
        self.least = min(power, self.least / self._decay)
        self.active = power > max(FLOOR, RANGE * self.peak)
        if not self.active:
            return None
        fresh = self.now - self.current.end > PAUSE
        if fresh:
            self.current = Utterance(self.now - 2 * self._hop, self.now, self.current.end)
        self.current.end = self.now
        return self.current if fresh else None
