"""The membrane's displacement against scipy's filter."""

import numpy as np
import pytest
from scipy import signal

from edgefilter.dsp.membrane import DISPLACEMENT_HZ, displacement_taps


@pytest.mark.parametrize("rate", [8000, 16000])
def test_the_membrane_is_a_butterworth_low_pass(rate):
    b, a = signal.butter(2, DISPLACEMENT_HZ, fs=rate)
    exact = signal.lfilter(b, a, np.eye(1, 4096)[0])
    response = displacement_taps(rate)
    np.testing.assert_allclose(
        response, exact[: response.size], atol=1e-6 * exact.max()
    )  # what the sampling folds back
    assert np.abs(exact[response.size :]).max() < 1e-4 * exact.max()  # what is cut off: 80 dB down
