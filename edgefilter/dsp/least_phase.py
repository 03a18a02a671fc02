"""The phase that goes with a gain, where a response delays nothing more than it has to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.types import Array


def log_response(log_gain: Array) -> NDArray[np.complex128]:
    """Complex logarithm of the causal response of least phase with that gain, from its logarithm, 0 to Nyquist, (bins, ...).

    By its real cepstrum, folded onto positive times (Oppenheim & Schafer 2010, section 13.5).
    """
    bins = log_gain.shape[0]
    cepstrum = fft.irfft(log_gain, axis=0)
    cepstrum[1 : bins - 1] *= 2.0
    cepstrum[bins:] = 0.0
    return fft.rfft(cepstrum, axis=0)
