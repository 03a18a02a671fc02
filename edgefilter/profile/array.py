"""What a calibration measured of the further microphones of an array, and of the noise between all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from edgefilter.dsp.psd import GRID_BINS, GRID_FFT
from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import ProfileError
from edgefilter.profile.file import REMEDY, ProfilePart, described
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
        responses, noise = np.asarray(self.responses), np.asarray(self.noise)
        if responses.dtype != np.float32 or responses.ndim != 2 or not 1 <= len(responses) < MOST_MICROPHONES:
            self._refuse("responses", described(responses), f"float32 of shape (1 to {MOST_MICROPHONES - 1}, taps)")
        if not np.all(np.abs(responses) <= 1e3):
            raise ProfileError(f"{self.PREFIX}responses is not within -1000 to 1000 everywhere; {REMEDY}")
        count = len(responses) + 1
        if noise.dtype != np.float32 or noise.shape != (GRID_BINS, count, count, 2):
            self._refuse("noise", described(noise), f"float32 of shape ({GRID_BINS}, {count}, {count}, 2)")
        if not np.all(np.abs(noise) <= 1.0):
            raise ProfileError(f"{self.PREFIX}noise is not within -1 to 1 everywhere; {REMEDY}")

    def noise_covariance(self, stft: StftConfig) -> Spectrum:
        """Expected X_i conj(X_j) of the fan in one frame of stft, (microphones, microphones, bins) complex64."""
        density = self.noise[..., 0] + 1j * self.noise[..., 1]
        at = stft.frequencies * GRID_FFT / SAMPLE_RATE
        low = np.minimum(at.astype(int), GRID_BINS - 2)
        share = (at - low)[:, None, None]
        found = (1.0 - share) * density[low] + share * density[low + 1]
        scale = 0.5 * SAMPLE_RATE * stft.noise_gain()
        return np.ascontiguousarray(found.transpose(1, 2, 0) * scale, np.complex64)
