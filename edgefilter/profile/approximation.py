"""What a linear path makes of the robot's voice at several volumes, and what it leaves: noise, even and odd distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from edgefilter.dsp.frames import decibels
from edgefilter.dsp.psd import GRID_BINS, total_power
from edgefilter.profile.file import ProfilePart, described, refuse
from edgefilter.types import Array, Samples

STEEPEST = 2.0
"""dB by which a distortion grows over the voice for each dB of the voice: that of a cubic law; a square one has 1."""
CLEARLY_DB = 3.0
"""By which a power is clearly more than another that it is held against, and no chance."""


@dataclass(frozen=True, eq=False)
class LinearApproximation(ProfilePart):
    """The best linear approximation of the robot at each of L levels, from multisines.

    The best linear approximation is the linear path that leaves the least power of sounds of this spectrum and level;
    what it leaves behaves as noise (Pintelon & Schoukens 2012, "System Identification: A Frequency Domain Approach",
    sec. 3.4). All but level_db are power spectral densities, one-sided, full scale^2/Hz, at 0 to 8 kHz.

    Parameters
    ----------
    level_db : ndarray of float64, shape (L,)
        What was played, dB of full scale (its mean square), the softest first.
    played, linear : ndarray of float32, shape (L, 601)
        What was played, and the part of the microphone's recording that is it through the best linear approximation.
    noise, even, odd : ndarray of float32, shape (L, 601)
        The rest: what changes from period to period, and the distortions of even and of odd order. The noise is taken
        off the distortions, and off the linear part, so that chance can make them negative.
    least_db : ndarray of float64, shape (L,)
        Power over that of the linear part below which a distortion is not told from the noise, dB.

    Raises
    ------
    ProfileError
        Where an array has another shape or type, is not finite or out of range.
    """

    PREFIX: ClassVar[str] = "approximation_"

    level_db: Array
    played: Samples
    linear: Samples
    noise: Samples
    even: Samples
    odd: Samples
    least_db: Array

    def __post_init__(self) -> None:
        levels = np.asarray(self.level_db)
        if levels.dtype != np.float64 or levels.ndim != 1 or not levels.size:
            refuse(f"{self.PREFIX}level_db", described(levels), "float64 of one level or more")
        if not (np.all(np.abs(levels) <= 300.0) and np.all(np.diff(levels) > 0.0)):
            refuse(f"{self.PREFIX}level_db", levels.tolist(), "rising levels of -300 to 300 dB")
        self._check("least_db", levels.shape, np.float64, 300.0)
        for name in ("played", "linear", "noise", "even", "odd"):
            self._check(name, (levels.size, GRID_BINS), np.float32, 1e6)

    @property
    def gain(self) -> Samples:
        """Magnitude of the best linear approximation, 0 where nothing was played, (L, 601)."""
        heard = self.played > 1e-6 * self.played.max(axis=1, keepdims=True)
        return np.sqrt(np.maximum(self.linear, 0.0) / np.where(heard, self.played, 1.0)) * heard

    def over_linear_db(self, *names: str) -> Array:
        """Power of those named of "noise", "even" and "odd", over that of the linear part, (L,) in dB."""
        rest = [sum(total_power(getattr(self, name)[i]) for name in names) for i in range(len(self.level_db))]
        return decibels(np.array(rest) / self._linear_power, 1e-10)

    @property
    def _linear_power(self) -> Array:
        """Mean square of the linear part, (L,)."""
        return np.array([max(total_power(psd), 1e-20) for psd in self.linear])

    @property
    def share(self) -> float:
        """Power of the distortion over that of the linear part where it was played loudest."""
        return float(10 ** (self.over_linear_db("even", "odd")[-1] / 10))

    @property
    def colour(self) -> Array:
        """Spectral density of the distortion per Hz of integral 1, where it was played loudest, (601,)."""
        density = np.maximum(self.even[-1] + self.odd[-1], 0.0).astype(np.float64)
        return density / max(total_power(density), 1e-30)

    def expected(self, power: Array) -> Array:
        """Power of the distortion in sound whose linear part at the microphone has that power, an array of any shape.

        Its share of that power, in dB, lies on straight lines between the levels at which it is clearly told from the
        noise. Beyond them it follows the level as there on the whole, but no steeper than the distortion of a cubic law
        and not falling; where one level alone tells, as that of a square law.
        """
        level, share = decibels(self._linear_power, 1e-20), self.over_linear_db("even", "odd")
        told = share > self.least_db + CLEARLY_DB
        told[-1] = True
        level, share = level[told], share[told]
        slope = 1.0
        if level.size > 1:
            slope = float(np.clip((share[-1] - share[0]) / (level[-1] - level[0]), 0.0, STEEPEST))
        at = decibels(power, 1e-20)
        beyond = np.maximum(at - level[-1], 0.0) + np.minimum(at - level[0], 0.0)
        return power * np.clip(10 ** ((np.interp(at, level, share) + slope * beyond) / 10), 0.0, 1.0)
