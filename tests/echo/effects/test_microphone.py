"""Effects at the microphone, clipping and gain control, and the fan."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from edgefilter.echo.effect import complete, neutral
from edgefilter.echo.effects import catalogue
from tests.conformance import fan, robot_alone


def test_a_hard_clip_is_found_at_its_level():
    measurement, model = robot_alone()
    clipped = np.clip(measurement.recording, -0.2, 0.2)
    found = catalogue.find("mic_clipping").fit(replace(measurement, recording=clipped), model)
    assert found["level"] == pytest.approx(0.2, rel=0.01) and found["hardness"] == 100.0


def test_a_soft_limiter_is_found_soft():
    found = catalogue.find("mic_clipping").fit(*robot_alone("mic_clipping", {"level": 0.2, "hardness": 3.0}))
    assert found["hardness"] < 10.0 and found["level"] == pytest.approx(0.2, rel=0.15)


def test_soft_limiter_never_exceeds_its_level_and_keeps_small_values():
    clip = catalogue.find("mic_clipping")
    x = np.linspace(-5, 5, 1001, dtype=np.float32)
    out = clip.apply(x, {"level": 0.5, "hardness": 4.0}, 16_000)
    assert np.abs(out).max() <= 0.5 and np.all(np.diff(out) >= 0)
    small = np.abs(x) < 0.1
    np.testing.assert_allclose(out[small], x[small], rtol=1e-3)  # (0.1 / 0.5)^4 / 4


def test_a_loud_recording_below_any_limit_is_left_alone():
    measurement, model = robot_alone("playback_gain", {"gain_db": 3.0})
    found = catalogue.find("mic_clipping").fit(measurement, model)
    predicted = model.predict(measurement.reference)
    # a faint cubic distortion, which every loudspeaker has, may look like the beginning of a limiter
    assert (
        np.abs(catalogue.find("mic_clipping").apply(predicted, found, 16_000) - predicted).max()
        < 0.05 * np.abs(predicted).max()
    )


def through_agc(curve_db, gain_db=0.0):
    """A recording whose voice and fan both got that gain, knots every 0.25 s; and the model."""
    measurement, model = robot_alone(gain_db=gain_db)
    agc = catalogue.find("mic_agc")
    recording = agc.apply(measurement.recording, complete(agc, {"gain_db": curve_db}), 16_000)
    return replace(measurement, recording=recording), model


def test_gain_control_is_followed_through_speech_and_pauses():
    t = np.arange(48) / 4.0
    curve = 4.0 * np.sin(2 * np.pi * t / 7.0) - 1.0
    found = catalogue.find("mic_agc").fit(*through_agc(curve))
    # half of the blocks are held out, their knots interpolated
    assert np.sqrt(np.mean((found["gain_db"][:48] - curve) ** 2)) < 0.4
    assert found["range_db"] == pytest.approx(np.ptp(np.percentile(curve, [5, 95])), abs=0.7)
    assert 0.8 < found["time_constant_s"] < 2.0  # a sine of period 7 s falls to 1/e after 1.3 s


def test_gain_control_at_a_step_between_knots_is_linear_in_db():
    agc = catalogue.find("mic_agc")
    out = agc.apply(np.ones(8000, np.float32), complete(agc, {"gain_db": np.array([0.0, 6.0])}), 16_000)
    np.testing.assert_allclose(20 * np.log10(out[[0, 1000, 2000, 4000, 7999]]), [0.0, 1.5, 3.0, 6.0, 6.0], atol=1e-3)


def test_a_gain_that_stands_still_is_no_gain_control_but_the_volume():
    measurement, model = robot_alone("playback_gain", {"gain_db": -2.0})
    agc, volume = map(catalogue.find, ("mic_agc", "playback_gain"))
    assert agc.fit(measurement, model) == neutral(agc)
    assert volume.fit(measurement, model)["gain_db"] == pytest.approx(-2.0, abs=0.2)


def test_fan_that_is_louder_in_a_band_is_found_in_that_band():
    measurement, model = robot_alone()
    band = signal.sosfilt(
        signal.butter(6, [2000, 3000], "band", fs=16_000, output="sos"),
        np.random.default_rng(5).standard_normal(192_000),
    )
    louder = replace(measurement, recording=measurement.recording + (0.002 * band).astype(np.float32))
    found = catalogue.find("fan_noise").fit(louder, model)
    hz = np.arange(601) * 8000 / 600
    inside, outside = (hz > 2200) & (hz < 2800), (hz < 1500) | (hz > 3600)
    # white noise of variance 0.002^2 has a one-sided PSD of that over 8 kHz
    expected = 10 * np.log10(1 + 0.002**2 / 8000 / measurement.noise_psd[inside].mean())
    assert np.median(found["spectrum_db"][inside]) == pytest.approx(expected, abs=1.0)
    assert abs(np.median(found["spectrum_db"][outside])) < 0.6


def test_fan_change_is_that_of_its_power_and_its_psd_follows():
    measurement, model = robot_alone()
    silent = replace(measurement, reference=np.zeros_like(measurement.reference), recording=2 * fan(192_000, seed=9))
    found = catalogue.find("fan_noise").fit(silent, model)
    assert found["change_db"] == pytest.approx(20 * np.log10(2), abs=0.3)
    changed = catalogue.find("fan_noise").noise_psd(found, measurement.noise_psd)
    assert changed.shape == (601,) and changed.dtype == np.float32
    assert 10 * np.log10(changed.sum() / measurement.noise_psd.sum()) == pytest.approx(found["change_db"], abs=0.1)


def test_fan_is_found_under_a_robot_that_never_pauses():
    rng = np.random.default_rng(6)
    measurement, model = robot_alone()
    reference = (0.1 * rng.standard_normal(192_000)).astype(np.float32)
    recording = model.predict(reference) + np.float32(10 ** (3 / 20)) * fan(192_000, seed=8)
    found = catalogue.find("fan_noise").fit(replace(measurement, reference=reference, recording=recording), model)
    assert found["change_db"] == pytest.approx(3.0, abs=0.5)


@pytest.mark.parametrize("change_db", [12.0, -6.0])
def test_fan_that_changes_later_on_is_found_with_its_moment_and_stays_as_it_became(change_db):
    """It swung, so nothing was found, and beside another effect the verdict was "unexplained"."""
    measurement, model = robot_alone()
    grown = np.interp(np.arange(192_000), [80_000, 96_000], [0.0, 1.0]).astype(np.float32)
    talks = np.arange(192_000) // 8000 % 3 > 0
    measurement = replace(measurement, reference=measurement.reference * talks)
    voice, new = model.predict(measurement.reference), np.float32(10 ** (change_db / 20)) * fan(192_000, seed=9)
    now = voice + np.sqrt(1 - grown) * fan(192_000, seed=8) + np.sqrt(grown) * new
    found = model.fitted("fan_noise", replace(measurement, recording=now))
    assert 5.0 <= found["from_s"] <= 6.5 and found["change_db"] == pytest.approx(change_db, abs=0.7)
    heard = catalogue.find("fan_noise").passed(new, voice, found, 16_000)
    assert 20 * np.log10(np.std(heard[:80_000]) / np.std(heard[100_000:])) == pytest.approx(-change_db, abs=1.0)
    known = model.with_effect("fan_noise", found)
    here, *others = known.during(replace(measurement, recording=now)), known.during(measurement), known.lasting()
    assert here is known
    for other in others:
        values = dict(other.effects)["fan_noise"]
        assert (values["from_s"], values["change_db"]) == (0.0, found["change_db"])


def test_calibrated_fan_has_not_changed():
    found = catalogue.find("fan_noise").fit(*robot_alone())
    assert abs(found["change_db"]) < 0.3 and np.abs(np.median(found["spectrum_db"])) < 0.3
