"""Calibration of an array: the echo paths of its further microphones, and the fan between all of them."""

from __future__ import annotations

import numpy as np
from scipy import fft

from edgefilter.calibration.sweep import Deconvolution
from edgefilter.dsp.exchange import EQUAL
from edgefilter.dsp.frames import frames
from edgefilter.dsp.psd import GRID_FFT, hann
from edgefilter.types import SAMPLE_RATE, Samples

APART_DB = 10.0
"""Difference of the fan's level to the median microphone's that equal microphones never have: on a real robot with four,
the three of its array agree within 1 dB and the fourth, of another kind, is 12 to 18 dB louder."""
FARTHEST = 32
"""Samples between the direct sound in two microphones of one robot: .7 m."""


def first(recordings: Samples) -> Samples:
    """The first microphone of recordings (n,) or (microphones, n), (n,)."""
    return recordings if recordings.ndim == 1 else recordings[0]


def cross_density(noises: Samples) -> Samples:
    """Spectral covariance of noises (microphones, n), as ArrayCalibration.noise, (601, microphones, microphones, 2) float32."""
    window = hann(GRID_FFT)
    spectra = fft.rfft([frames(one, GRID_FFT, GRID_FFT // 2) * window for one in noises.astype(np.float64)])
    found = np.einsum("itk,jtk->kij", spectra, spectra.conj()) / (spectra.shape[1] * SAMPLE_RATE * np.sum(window**2))
    found[1:-1] *= 2.0
    return np.stack((found.real, found.imag), axis=-1).astype(np.float32)


def doubts(noises: Samples, results: list[Deconvolution]) -> list[str]:
    """What is doubtful about microphones beside one another: noises (microphones, n), and what was deconvolved of each."""
    found = []
    power = np.mean(np.square(noises, dtype=np.float64), axis=1)
    level = 10 * np.log10(power + 1e-20)
    for at, apart in enumerate(level - np.median(level)):
        if abs(apart) > APART_DB:
            how = "louder" if apart > 0 else "softer"
            found.append(
                f"channel {at}: the fan is {abs(apart):.0f} dB {how} there than elsewhere; another gain or kind?"
            )
    for at, result in enumerate(results):
        lag = result.direct - results[0].direct
        if abs(lag) > FARTHEST:
            found.append(
                f"channel {at}: hears the robot {lag} samples after channel 0; another converter, or processed?"
            )
    found += [
        f"channel {j}: the same sound as channel {i}; leave one of them out"
        for j in range(len(noises))
        for i in range(j)
        if np.mean(np.square(noises[i] - noises[j], dtype=np.float64)) < EQUAL * max(power[i], 1e-20)
    ]
    return found
