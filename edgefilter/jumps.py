"""When a jump of the delay is believed: looks of the tracker that agree add up their evidence."""

from __future__ import annotations

from edgefilter.delay_tracker import Measurement

JUMP, SMALL_JUMP, SMALL = 30.0, 20.0, 8.0
"""Evidence, summed over looks that agree, from which a jump is believed, and what does for one of up to SMALL samples, where chance
has less to choose from. In 14 minutes each of human speech and of fan noise while the reference played unheard, twice as densely looked
at as in use, single looks reached 24 and 19, a tenth as often 5 less; consecutive ones, which overlap by three quarters, agreed on
11 each at most."""
AGREE = 0.7
"""Samples within which two looks see the same jump."""
FORGET = 0.7
"""What is left of a suspicion after a look that saw another jump."""


class JumpWitness:
    """Remembers the most suspicious jump of late, and the evidence for it.

    >>> from edgefilter.delay_tracker import Measurement
    >>> look = Measurement(offset=100.0, variance=0.01, strength=10.0, ratio=1.6, dominance=5.0, explained=0.5, gain=1.0, gain_there=1.0)
    >>> witness = JumpWitness()
    >>> witness.convinced(look), witness.convinced(look)
    (False, True)
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """The delay was confirmed or replaced."""
        self._offset, self._evidence = float("nan"), 0.0

    def convinced(self, found: Measurement) -> bool:
        """Take in a look at which the delay seems to have jumped by its offset; True if that is now beyond chance."""
        if abs(found.offset - self._offset) < AGREE:
            self._evidence += found.evidence
        else:
            self._evidence *= FORGET
            if found.evidence <= self._evidence:
                return False
            self._evidence = found.evidence
        self._offset = found.offset
        return self._evidence > (JUMP if abs(found.offset) > SMALL else SMALL_JUMP)
