"""Frames, blocks, power and densities against sums written out."""

import numpy as np
import pytest
from scipy import signal

from edgefilter.dsp.frames import all_block_power, block_power, block_sums, blocks, decibels, frames, rise, stretch
from edgefilter.dsp.psd import (
    NOTCH,
    ROUNDING_PSD,
    floored,
    frequencies,
    periodograms,
    third_octave_bands,
    total_power,
    variance_at,
)


def test_frames_are_what_slices_are_and_none_where_the_signal_is_shorter():
    x = np.arange(23.0)
    np.testing.assert_array_equal(frames(x, 8, 5), [x[at : at + 8] for at in (0, 5, 10, 15)])
    assert frames(x[:7], 8, 5).shape == (0, 8)


def test_block_power_leaves_the_end_out_and_the_other_counts_it():
    x = np.array([1, 1, 2, 2, 3], np.float32)
    np.testing.assert_array_equal(blocks(x, 2), [[1, 1], [2, 2]])
    np.testing.assert_allclose(block_power(x, 2), [1.0, 4.0])
    np.testing.assert_allclose(all_block_power(x, 2), [1.0, 4.0, 4.5])
    np.testing.assert_array_equal(block_sums(x, 2), [2.0, 4.0])
    assert block_power(x, 2).dtype == np.float64


def test_decibels_stop_at_the_least():
    np.testing.assert_allclose(decibels(np.array([0.0, 1e-12, 1.0, 100.0])), [-120.0, -120.0, 0.0, 20.0])


def test_the_mean_periodogram_is_welchs_estimate():
    x = np.random.default_rng(0).standard_normal(16_000).astype(np.float32)
    exact = signal.welch(x, 16_000, nperseg=1200, detrend=False)[1]
    np.testing.assert_allclose(periodograms(x, 1200).mean(axis=0), exact, rtol=1e-4)  # float32 input
    assert total_power(exact) == pytest.approx(1.0, rel=0.05)  # of 16000 independent values


def test_a_density_is_floored_under_its_maximum_and_above_rounding():
    psd = np.array([1.0, 1e-9, 1e-3], np.float32)
    np.testing.assert_allclose(floored(psd), [1.0, NOTCH, 1e-3], rtol=1e-6)
    assert floored(np.zeros(3, np.float32)).min() == ROUNDING_PSD


def test_white_noise_of_variance_one_has_variance_one_at_every_frequency():
    assert frequencies(601)[-1] == 8000.0
    np.testing.assert_allclose(
        variance_at(np.array([0.0, 777.7, 8000.0]), np.full(601, 1 / 8000, np.float32)), 1.0, rtol=1e-6
    )


def test_third_octaves_hold_a_thousand_hertz_and_end_at_eight():
    bands = third_octave_bands()
    np.testing.assert_allclose(bands[1:, 0], bands[:-1, 1])
    assert np.any((bands[:, 0] < 1000) & (bands[:, 1] > 1000)) and bands[-1, 1] == 8000.0


def test_a_stretch_is_a_new_array_and_zero_where_the_signal_has_nothing():
    x = np.arange(1, 6, dtype=np.float32)
    assert stretch(x, -2, 3).tolist() == [0, 0, 1, 2, 3] and stretch(x, 3, 8).tolist() == [4, 5, 0, 0, 0]
    assert stretch(x, 7, 9).tolist() == stretch(x, -9, -7).tolist() == [0, 0] and stretch(x, 2, 2).size == 0
    inside = stretch(x, 1, 4)
    assert inside.dtype == np.float32 and not np.shares_memory(inside, x)


def test_a_rise_and_its_mirror_image_add_up_to_one():
    np.testing.assert_allclose(rise(8) + rise(8)[::-1], 1.0, rtol=1e-12)
    assert (np.diff(rise(8)) > 0).all()
