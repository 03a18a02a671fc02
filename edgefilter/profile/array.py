"""What a calibration measured of the further microphones of an array, and of the noise between all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from edgefilter.dsp.psd import GRID_BINS, GRID_FFT
from edgefilter.dsp.stft import StftConfig
from edgefilter.profile.file import ProfilePart, described, refuse
from edgefilter.types import MOST_MICROPHONES, SAMPLE_RATE, Samples, Spectrum


@dataclass(frozen=True, eq=False)
class ArrayCalibration(ProfilePart):
    """Echo paths of the further microphones, and the noise of all as cross-spectral densities.

    Parameters
    ----------
    responses : ndarray of float32, shape (microphones - 1, taps)
        Of each further microphone the impulse response, on the clock of the first microphone's: all begin PRE_ROLL
        samples before the direct sound in the first one.
    noise : ndarray of float32, shape (601, microphones, microphones, 2)
        One-sided cross-spectral density of the fan, real and imaginary part, full scale^2/Hz, at 0 to 8000 Hz in steps of
        13.33; [k, i, j] is the mean of X_i conj(X_j).

    Raises
    ------
    ProfileError
        Where an array has another shape or type, is not finite or out of range.
    """

    PREFIX: ClassVar[str] = "array_"

    responses: Samples
    noise: Samples

    def __post_init__(self) -> None:
        responses = np.asarray(self.responses)
        if responses.ndim != 2 or not 1 <= len(responses) < MOST_MICROPHONES:
            refuse(
                f"{self.PREFIX}responses", described(responses), f"float32 of shape (1 to {MOST_MICROPHONES - 1}, taps)"
            )
        self._check("responses", responses.shape, np.float32, 1e3)
        count = len(responses) + 1
        self._check("noise", (GRID_BINS, count, count, 2), np.float32, 1.0)

    def noise_covariance(self, stft: StftConfig) -> Spectrum:
        """Expected X_i conj(X_j) of the fan in one frame of stft, (microphones, microphones, bins) complex64."""
        density = self.noise[..., 0] + 1j * self.noise[..., 1]
        at = stft.frequencies * GRID_FFT / SAMPLE_RATE
        low = np.minimum(at.astype(int), GRID_BINS - 2)
        share = (at - low)[:, None, None]
        found = (1.0 - share) * density[low] + share * density[low + 1]
        scale = 0.5 * SAMPLE_RATE * stft.noise_gain()
        return np.ascontiguousarray(found.transpose(1, 2, 0) * scale, np.complex64)
