"""The compressor follows its static curve and its times, and the fit finds them again."""

import numpy as np
import pytest

from edgefilter.echo.effect import complete, neutral
from edgefilter.echo.effects import catalogue
from edgefilter.echo.effects.compression import falling_peak
from tests.conformance import held_out_power, robot_alone

COMPRESS = catalogue.find("compression")


def gain_db(level, values):
    """Settled gain of a 1 kHz tone with that RMS level, dB."""
    tone = (10 ** (level / 20) * np.sqrt(2) * np.sin(2 * np.pi * np.arange(32_000) / 16)).astype(np.float32)
    out = COMPRESS.apply(tone, complete(COMPRESS, values), 16_000)
    return 20 * np.log10(np.std(out[-8000:]) / np.std(tone[-8000:]))


@pytest.mark.parametrize(
    ("level", "expected"), [(-40.0, 0.0), (-23.0, -0.0), (-20.0, -0.5625), (-17.0, -2.25), (-10.0, -7.5)]
)
def test_static_curve_of_ratio_4_above_minus_20_db_with_a_knee_of_6_db(level, expected):
    # in the knee 0.75 (over + 3)^2 / 12 dB come off, above it 0.75 of what is over; ripple of the mean square holds 0.1
    # dB at most
    values = {"threshold_db": -20.0, "ratio": 4.0, "knee_db": 6.0, "attack_ms": 10.0}
    assert gain_db(level, values) == pytest.approx(expected, abs=0.1)
    assert gain_db(level, {**values, "makeup_db": 5.0}) == pytest.approx(expected + 5.0, abs=0.1)


def test_release_is_the_time_to_1_over_e_of_the_reduction_in_db():
    tone = np.sin(2 * np.pi * np.arange(48_000) / 16).astype(np.float32) * np.where(
        np.arange(48_000) < 16_000, 0.5, 1e-3
    ).astype(np.float32)
    values = complete(COMPRESS, {"threshold_db": -20.0, "ratio": 4.0, "attack_ms": 1.0, "release_ms": 300.0})
    gain = 20 * np.log10(np.abs(COMPRESS.apply(tone, values, 16_000)) + 1e-12) - 20 * np.log10(np.abs(tone) + 1e-12)
    peaks = np.abs(np.sin(2 * np.pi * np.arange(48_000) / 16)) > 0.9
    before, after = gain[14_000:15_900][peaks[14_000:15_900]].mean(), gain[20_700:20_900][peaks[20_700:20_900]].mean()
    assert after == pytest.approx(
        before * np.exp(-1), rel=0.05
    )  # 300 ms are 4800 samples; the attack of 1 ms delays the start


def testfalling_peak_is_the_slow_recursion():
    x = np.abs(np.random.default_rng(0).standard_normal(500)) * (np.random.default_rng(1).uniform(size=500) > 0.8)
    slow, y = [], 1.7
    for value in x:
        y = max(value, y * np.exp(-1 / 37.0))
        slow.append(y)
    np.testing.assert_allclose(falling_peak(x, 37.0, before=1.7), slow, atol=1e-9)
    assert falling_peak(x[:1], 37.0, before=0.0)[0] == pytest.approx(x[0], abs=1e-9)


def test_fit_finds_threshold_ratio_and_times():
    truth = {"threshold_db": -20.0, "ratio": 4.0, "attack_ms": 8.0, "release_ms": 250.0, "makeup_db": 2.0}
    measurement, model = robot_alone("compression", truth, gain_db=0.0)
    found = dict(model.fit("compression", measurement).effects)["compression"]
    # four unknowns from some seconds 25 dB over the fan; knee and faint distortion are not the truth's exactly
    assert found["threshold_db"] == pytest.approx(-20.0, abs=1.0) and found["ratio"] == pytest.approx(4.0, rel=0.2)
    assert found["attack_ms"] == pytest.approx(8.0, rel=0.3) and found["release_ms"] == pytest.approx(250.0, rel=0.2)
    assert found["makeup_db"] == pytest.approx(2.0, abs=0.2)


def test_a_volume_that_was_turned_is_no_compression():
    measurement, model = robot_alone("playback_gain", {"gain_db": -4.0})
    assert COMPRESS.fit(measurement, model) == neutral(COMPRESS)
    assert held_out_power(measurement, model.predict(measurement.reference)) > 2.0
