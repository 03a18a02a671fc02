"""Clock drift and delay jumps: lags are tracked, each effect finds its own kind and declines the other's."""

import numpy as np
import pytest

from edgefilter.dsp.fractional_delay import delayed, interpolate
from edgefilter.echo.effect import complete
from edgefilter.echo.effects import catalogue
from edgefilter.echo.effects.delay_jump import find_steps
from edgefilter.echo.lag_track import track_lag
from tests.conformance import robot_alone, robot_speech


def tone(positions, hz=1000):
    return np.sin(2 * np.pi * hz * positions / 16_000)


@pytest.mark.parametrize("lag", [3.25, -7.6, 5.0, -5.0, 0.0, 20_000.0])
def test_a_constant_delay_moves_a_tone(lag):
    n = np.arange(16_000)
    moved = delayed(tone(n).astype(np.float32), lag)
    # a tone that is cut off rings a little at its ends; a delay beyond the end leaves silence
    expected = tone(n - lag) if lag < n.size else np.zeros(n.size)
    assert np.abs(moved - expected)[100:-100].max() < 3e-4


def test_reading_between_samples_is_the_same_as_the_slow_sum():
    rng = np.random.default_rng(0)
    x = rng.standard_normal(200).astype(np.float32)
    positions = np.r_[rng.uniform(-40, 240, 50), 0.0, 199.0, -1e6, 1e6]
    nuttall = (0.355768, 0.487396, 0.144232, 0.012604)

    def window(d):
        return sum(a * np.cos(k * np.pi * d / 25) for k, a in enumerate(nuttall)) * (np.abs(d) <= 24)

    k = np.arange(200)
    slow = [float(np.sum(x * np.sinc(k - p) * window(k - p))) for p in positions]
    np.testing.assert_allclose(interpolate(x, positions), slow, atol=3e-5)  # table of 256 phases, linear between them


def test_lag_track_reads_a_known_lag_to_a_hundredth_of_a_sample():
    x = robot_speech()
    heard = delayed(x, -123.37) + 0.001 * np.random.default_rng(0).standard_normal(x.size).astype(np.float32)
    track = track_lag(x, heard, None, 8000, 200)
    assert track.lag.size > 30
    assert np.abs(track.lag + 123.37).max() < 0.02 and np.all(track.sigma < 0.05)


def test_lag_track_uses_only_blocks_that_may_be_fitted_and_that_correlate():
    x = robot_speech()
    fit = np.arange(x.size) // 8000 % 2 == 0
    heard = delayed(x, 5.0)
    heard[64_000:72_000] = np.random.default_rng(1).standard_normal(8000)
    track = track_lag(x, heard, fit, 4000, 50)
    assert track.lag.size > 10
    assert all(fit[int(s) : int(s) + 4000].all() for s in track.starts) and not np.any(
        (track.starts >= 62_000) & (track.starts < 72_000)
    )
    assert np.abs(track.lag - 5.0).max() < 0.01


@pytest.mark.parametrize("ppm", [-450.0, -30.0, 6.0, 300.0])
def test_drift_is_found_over_the_whole_range(ppm):
    measurement, model = robot_alone("clock_drift", {"ppm": ppm, "offset": -4.2})
    found = catalogue.find("clock_drift").fit(measurement, model)
    # 12 s at 25 dB over the fan: the bound of Cramer and Rao is some hundredths of a ppm, faint distortion adds to it
    assert found["ppm"] == pytest.approx(ppm, abs=0.5) and found["offset"] == pytest.approx(-4.2, abs=0.05)


def test_jumps_are_found_to_the_sample_also_between_the_blocks_to_fit_on():
    # 3.3 s lies in a block to fit on, 8.9 s in one that is held out
    values = {"times_s": np.array([3.3, 8.9]), "samples": np.array([37.4, -61.25])}
    measurement, model = robot_alone("delay_jump", values)
    found = catalogue.find("delay_jump").fit(measurement, model)
    np.testing.assert_allclose(found["samples"], values["samples"], atol=0.05)
    np.testing.assert_allclose(found["times_s"], values["times_s"], atol=0.01)  # a few ms without energy do not tell
    assert abs(found["offset"]) < 0.05


def test_a_drift_is_no_jump():
    for ppm in (-300.0, -28.0, 60.0):
        found = catalogue.find("delay_jump").fit(*robot_alone("clock_drift", {"ppm": ppm}))
        assert not np.any(found["samples"]), ppm


def test_one_odd_block_is_no_jump():
    lag = np.full(40, 0.02)
    lag[17] = 900.0
    edges, levels = find_steps(lag, np.full(40, 0.05))
    assert edges.size == 0 and levels == pytest.approx([0.02])


def test_steps_closer_than_a_third_of_a_sample_are_one():
    lag = np.repeat([0.0, 0.2, 7.0], 15)
    edges, levels = find_steps(lag, np.full(45, 0.05))
    assert list(edges) == [30] and levels == pytest.approx([0.1, 7.0], abs=0.02)


def test_silence_in_the_gap_is_told_from_a_repetition():
    values = {"times_s": 3.3, "samples": 400.0}
    found = {
        gap: catalogue.find("delay_jump").fit(*robot_alone("delay_jump", {**values, "gap_gain": gap}))
        for gap in (0.0, 1.0)
    }
    assert {gap: fitted["gap_gain"] for gap, fitted in found.items()} == {0.0: 0.0, 1.0: 1.0}


def test_a_gap_is_silent_for_as_long_as_the_delay_grows():
    jump = catalogue.find("delay_jump")
    x = np.ones(1000, np.float32)
    values = {"times_s": np.array([0.02, 0.04]), "samples": np.array([100.0, -50.0]), "gap_gain": 0.0}
    out = jump.apply(x, complete(jump, values), 16_000)
    assert np.flatnonzero(out < 0.5).tolist() == list(range(320, 420))
