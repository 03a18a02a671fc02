"""EchoModel: the robot's own voice at the microphone as a chain of physical effects around a linear path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import signal

from edgefilter.types import Array, Samples

PRE_ROLL = 64
"""Samples (4 ms) of the impulse response before the direct sound: what equalisers and linear-phase filters of a loudspeaker ring ahead of it."""

Values = Mapping[str, "float | Array"]


@dataclass(frozen=True, eq=False)
class EchoModel:
    """A linear path and the effects around it.

    impulse_response: (taps,) float32 from the reference to the microphone, starting PRE_ROLL samples before the direct sound.
    effects: (name, values) in the order in which they were added.
    """

    impulse_response: Samples
    effects: tuple[tuple[str, Values], ...] = ()

    def predict(self, reference: Samples) -> Samples:
        """The robot's voice at the microphone (n,) for an aligned reference (n,)."""
        return signal.oaconvolve(reference, self.impulse_response)[: reference.size].astype(np.float32)
