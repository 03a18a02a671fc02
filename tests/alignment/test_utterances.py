"""Where utterances begin in the reference: above the last bit of a 24-bit converter."""

import numpy as np
import pytest

from edgefilter.alignment.utterances import OnsetDetector

HOP = 256
LAST_BIT = 2.0**-23


@pytest.mark.parametrize("amplitude, begins", [(0.9 * LAST_BIT, False), (1.1 * LAST_BIT, True)])
def test_a_reference_below_a_converters_last_bit_is_silent(amplitude, begins):
    detector = OnsetDetector(HOP)
    assert detector.step(np.zeros(HOP, np.float32)) is None
    found = detector.step(np.full(HOP, amplitude, np.float32))
    assert (found is not None) is detector.active is begins
