"""Lags are found between the samples, and one top is climbed from either side of it."""

import numpy as np
import pytest
from scipy import fft

from edgefilter.dsp.fractional_delay import delayed
from edgefilter.dsp.lag import climb, correlation_near, flat_cross, flattened, highest, likely_cross, top

N = 8192


def noise(seed: int = 0) -> np.ndarray:
    """(4000,) white, silent at both ends, so that a delay loses nothing."""
    return np.pad(np.random.default_rng(seed).standard_normal(3000), 500).astype(np.float32)


@pytest.mark.parametrize("lag", [0.0, 17.0, -3.25, 12.5, -12.5, 0.49])
@pytest.mark.parametrize("way", [flat_cross, likely_cross])
def test_the_top_of_the_correlation_is_the_delay(way, lag):
    x = 30.0 * noise()
    cross = way(x, delayed(x, lag), N)
    near = correlation_near(cross, N, 40)
    whole, height = highest(near)
    assert near.shape == (81,)
    assert abs(whole - lag) <= 0.5 + 1e-6
    assert height > 5.0  # one value of 81 that holds nearly all of the energy stands out by up to 9
    assert top(cross, N, float(whole)) == pytest.approx(lag, abs=2e-3)  # rumble is left out and smoothing errs a little


@pytest.mark.parametrize("start", [12.0, 13.0])
def test_a_top_halfway_between_two_samples_is_reached_from_both(start):
    """Without a limit to its steps Newton's method went to and fro between 12 and 13."""
    x = noise()
    omega = 2 * np.pi * np.arange(N // 2 + 1) / N
    cross = fft.rfft(delayed(x, 12.5).astype(float), N) * fft.rfft(x.astype(float), N).conj()
    assert climb(cross, omega, start, steps=3) == pytest.approx(12.5, abs=1e-4)


def test_the_top_is_climbed_in_the_precision_of_the_frequencies():
    x = noise()
    omega = (2 * np.pi * np.arange(N // 2 + 1) / N).astype(np.float32)
    cross = (fft.rfft(delayed(x, 3.3), N) * fft.rfft(x, N).conj()).astype(np.complex64)
    assert climb(cross, omega, 3.0) == pytest.approx(3.3, abs=1e-3)


def test_no_top_is_sought_beyond_a_sample():
    x = noise()
    cross = fft.rfft(delayed(x, 9.0).astype(float), N) * fft.rfft(x.astype(float), N).conj()
    assert abs(climb(cross, 2 * np.pi * np.arange(N // 2 + 1) / N, 4.0) - 4.0) <= 1.0


@pytest.mark.parametrize("dtype", [np.complex64, np.complex128])
def test_flattening_takes_colour_and_level_away_and_keeps_phase_and_precision(dtype):
    spectrum = fft.rfft(noise()).astype(dtype)
    colour = np.geomspace(1.0, 100.0, spectrum.size).astype(spectrum.real.dtype)
    flat = flattened(spectrum * colour, 1e-6)
    assert flat.dtype == dtype
    np.testing.assert_allclose(flat / np.abs(flat), spectrum / np.abs(spectrum), atol=1e-4)
    parts = np.array([np.mean(np.abs(part) ** 2) for part in np.array_split(flat, 8)])
    np.testing.assert_allclose(
        parts, 1.0, rtol=0.1
    )  # means over 250 bins of noise that is divided by its own smoothed power
