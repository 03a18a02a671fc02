"""Convolution in blocks is convolution."""

import numpy as np
import pytest
from scipy.signal import oaconvolve

from edgefilter.dsp.convolution import convolve


@pytest.mark.parametrize(
    "n, taps", [(1, 1), (100, 7), (700, 700), (3000, 3), (50_000, 1), (48_000, 6400), (65_537, 255)]
)
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_it_is_the_full_convolution_of_the_same_kind(n, taps, kind):
    rng = np.random.default_rng(n + taps)
    x, response = rng.standard_normal(n).astype(kind), rng.standard_normal(taps).astype(kind)
    found = convolve(x, response)
    assert found.shape == (n + taps - 1,) and found.dtype == kind
    expected = oaconvolve(x.astype(np.float64), response.astype(np.float64))
    assert np.max(np.abs(found - expected)) < 2e3 * np.finfo(kind).eps * np.sqrt(taps)
