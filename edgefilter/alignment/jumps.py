"""What one look of the tracker says, and when a jump is believed: looks that agree add up their evidence."""

from __future__ import annotations

from edgefilter.alignment.delay_tracker import REACH, DelayMeasurement

SMALL, SMALL_JUMP, JUMP, FAR_JUMP = 8.0, 20.0, 30.0, 50.0
"""Evidence, summed over looks that agree, from which a jump is believed: of up to SMALL samples, of up to REACH, and
beyond, for chance has more to choose from. In 7 minutes each of human speech and of fan noise while the reference
played unheard, looked at twice as densely as in use, the sums reached 19 and 14 within REACH, 29 and 13 beyond. Their
tails are exponential: 30 comes about once in 100 hours of such speech, 50 beyond REACH once in 5 if all looks went that
far."""
AGREE = 0.7
"""Samples within which two looks see the same jump."""
FORGET = 0.7
"""What is left of a suspicion after a look that saw another jump."""
HEARD = 6.0
"""Strength of the tracker's peak over the rms of +-REACH lags from which a look counts."""
FAINT, STRANGE, EDGE = 0.25, 10.0, 64
"""Power over what the robot brings below which and above which it is not the robot that is heard, so that no jump can
be seen, and samples at the edge of the looks' reach at which none is believed."""
DRIFTED = 1.5
"""Samples of a sudden error up to which it is put down to the drift: buffers that are lost or repeated have more."""
EXPECTED, UNLIKELY, TINY = 3.0, 5.0, 0.3
"""Surprise, in standard deviations, up to which an error of up to SMALL samples is drift, and one of up to DRIFTED; and
samples of error that are drift whatever the surprise."""


def where_seen(found: DelayMeasurement, surprise: float, gain: float, reach: int) -> str:
    """Whether a look saw the robot where it was expected.

    "there": it did. "elsewhere": it saw it at another delay, if others agree. "unseen": not at all. "drowned": somebody
    louder hid it. surprise: of its offset, in standard deviations. gain: power that the robot has brought so far.
    reach: samples on each side.
    """
    size = abs(found.offset)
    if found.strength < HEARD:
        return "unseen"
    if (size < DRIFTED and (surprise < UNLIKELY or size < TINY)) or (size < SMALL and surprise < EXPECTED):
        return "there"
    if found.gain > STRANGE * gain:
        return "drowned"
    if not FAINT < found.gain_there / gain < STRANGE or size > reach - EDGE:
        return "unseen"
    return "elsewhere"


class JumpWitness:
    """Remembers the most suspicious jump of late, and the evidence for it.

    >>> from edgefilter.alignment.delay_tracker import DelayMeasurement
    >>> look = DelayMeasurement(offset=100.0, variance=0.01, strength=10.0, ratio=1.6, dominance=5.0, explained=0.5, gain=1.0, gain_there=1.0)
    >>> witness = JumpWitness()
    >>> witness.convinced(look), witness.convinced(look)
    (False, True)
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """The delay was confirmed or replaced."""
        self._offset, self._evidence = float("nan"), 0.0

    def convinced(self, found: DelayMeasurement) -> bool:
        """Take in a look at which the delay seems to have jumped by its offset; True if that is now beyond chance."""
        if abs(found.offset - self._offset) < AGREE:
            self._evidence += found.evidence
        else:
            self._evidence *= FORGET
            if found.evidence <= self._evidence:
                return False
            self._evidence = found.evidence
        self._offset = found.offset
        size = abs(found.offset)
        return self._evidence > (SMALL_JUMP if size <= SMALL else JUMP if size <= REACH else FAR_JUMP)
