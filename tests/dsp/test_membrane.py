"""The membrane's displacement against scipy's filter."""

import numpy as np
from scipy import signal

from edgefilter.dsp.membrane import DISPLACEMENT_HZ, displacement_taps
from edgefilter.types import SAMPLE_RATE


def test_the_membrane_is_a_butterworth_low_pass():
    b, a = signal.butter(2, DISPLACEMENT_HZ, fs=SAMPLE_RATE)
    exact = signal.lfilter(b, a, np.eye(1, 4096)[0])
    response = displacement_taps()
    np.testing.assert_allclose(
        response, exact[: response.size], atol=1e-6 * exact.max()
    )  # what the sampling folds back
    assert np.abs(exact[response.size :]).max() < 1e-4 * exact.max()  # what is cut off: 80 dB down
