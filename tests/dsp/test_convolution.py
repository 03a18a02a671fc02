"""Convolution in blocks is convolution."""

import numpy as np
import pytest
from scipy.signal import oaconvolve

from edgefilter.dsp.convolution import convolve, filtered


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


@pytest.mark.parametrize("taps, lead", [(1, 0), (3, 2), (40, 8), (40, 39), (2000, 900), (3, 100)])
def test_a_filter_with_a_lead_hears_so_much_later_samples(taps, lead):
    rng = np.random.default_rng(taps)
    x, response = rng.standard_normal(9000).astype(np.float32), rng.standard_normal(taps)
    expected = np.pad(np.convolve(x, response), (0, 9000))[lead : lead + 9000]
    found = filtered(x, response, lead)
    assert found.dtype == np.float32 and np.allclose(found, expected, atol=1e-3)
