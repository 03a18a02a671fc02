"""What a calibration heard of a robot that moves while it talks: what sounds with its voice and is in no reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from edgefilter.dsp.frames import decibels
from edgefilter.dsp.psd import GRID_BINS, frequencies, total_power
from edgefilter.dsp.stft import StftConfig
from edgefilter.profile.file import ProfilePart, check_array
from edgefilter.types import Samples


@dataclass(frozen=True, eq=False)
class WhileMoving(ProfilePart):
    """What the running filter learned of a robot that talked and moved while nobody else spoke.

    Parameters
    ----------
    density : ndarray of float32, shape (601,)
        Power spectral density, 1/Hz, at 0 to 8000 Hz in steps of 13.33, of what sounds with the voice and is no echo, where
        the echo has the power 1. Chance can make it negative.
    moments : float
        How often the robot was taken for a human with more than even odds.
    seconds : float
        Of its voice, in which that was.

    Raises
    ------
    ProfileError
        Where the array has another shape or type, or a value is not finite or out of range.
    """

    PREFIX: ClassVar[str] = "moving_"

    density: Samples
    moments: float
    seconds: float

    def __post_init__(self) -> None:
        self._check("density", (GRID_BINS,), np.float32, 1e3)
        for name in ("moments", "seconds"):
            check_array(self.PREFIX + name, np.asarray(getattr(self, name)), (), np.float64, 0.0, 1e6)

    @property
    def level_db(self) -> float:
        """Power of the noise that comes with the voice, over that of the echo, dB."""
        return float(decibels(max(total_power(self.density), 0.0), 1e-12))

    @classmethod
    def learned(cls, with_voice: Samples, stft: StftConfig, moments: float, seconds: float) -> WhileMoving:
        """Make it of the noise that moves with the voice, a power (bins,) for stft, and of how often the robot was taken for a human in `seconds`."""
        density = np.interp(frequencies(GRID_BINS), stft.frequencies, with_voice) / stft.frequencies[1]
        return cls(density.astype(np.float32), moments, seconds)

    def with_voice(self, stft: StftConfig) -> Samples:
        """Power of that noise expected in each bin of a frame of stft, divided by the sum of the echo's power over all bins, (bins,)."""
        density = np.interp(stft.frequencies, frequencies(GRID_BINS), self.density)
        return (density * stft.frequencies[1]).astype(np.float32)
