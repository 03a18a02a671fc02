"""Loudspeaker distortion: the terms are what they are called, and the fit separates them from what is linear."""

import numpy as np
import pytest
from scipy import signal

from edgefilter.echo.effect import complete
from edgefilter.echo.effects import catalogue
from edgefilter.echo.effects.speaker_nonlinearity import displacement
from edgefilter.echo.measurement import Measurement
from tests.conformance import robot_alone, robot_model, robot_speech


def test_two_tones_through_even_give_their_sum_and_difference():
    t = np.arange(16_000) / 16_000
    x = (0.3 * np.sin(2 * np.pi * 1000 * t) + 0.3 * np.sin(2 * np.pi * 1700 * t)).astype(np.float32)
    distort = catalogue.find("speaker_nonlinearity")
    out = distort.apply(x, complete(distort, {"even": 0.5}), 16_000)
    spectrum = np.abs(np.fft.rfft(out - x)) / 8000
    # 0.5 * (a + b)^2: products at 700 and 2700 Hz of 0.5 * 0.3^2, octaves of half of that
    np.testing.assert_allclose(spectrum[[700, 2700, 2000, 3400]], [0.045, 0.045, 0.0225, 0.0225], rtol=1e-3)
    assert np.delete(spectrum, [0, 700, 2700, 2000, 3400]).max() < 1e-4


def test_displacement_follows_the_drive_below_the_resonance_and_falls_above():
    t = np.arange(16_000) / 16_000
    levels = [
        np.std(displacement(np.sin(2 * np.pi * hz * t).astype(np.float32))[4000:]) * np.sqrt(2)
        for hz in (50, 300, 3000)
    ]
    assert (
        levels[0] == pytest.approx(1.0, abs=0.01)
        and levels[1] == pytest.approx(np.sqrt(0.5), abs=0.01)
        and levels[2] < 0.02
    )


def test_without_noise_the_fit_returns_the_coefficients():
    x, model = robot_speech(), robot_model()
    truth = {"even": 0.4, "odd": -0.8}
    recording = model.with_effect("speaker_nonlinearity", truth).predict(x)
    found = catalogue.find("speaker_nonlinearity").fit(Measurement(x, recording), model)
    total = {name: float(np.sum(found[name])) for name in truth}
    # the ridge of 1e-3 and the filter on the linear part, which takes up the odd term's share of the voice, bias by a
    # few per cent
    assert total["even"] == pytest.approx(0.4, rel=0.05) and total["odd"] == pytest.approx(-0.8, rel=0.15)


def test_level_is_that_of_the_distortion_at_the_microphone():
    values = {"odd": -0.5}
    measurement, model = robot_alone("speaker_nonlinearity", values, gain_db=0.0)
    x = measurement.reference
    linear = measurement.whiten(model.predict(x))
    added = measurement.whiten(model.with_effect("speaker_nonlinearity", values).predict(x)) - linear
    added -= np.dot(added, linear) / np.dot(linear, linear) * linear
    expected = 10 * np.log10(np.mean(added**2) / np.mean(linear**2))
    found = catalogue.find("speaker_nonlinearity").fit(measurement, model)["level_db"]
    assert found == pytest.approx(
        expected, abs=1.0
    )  # the fan is 10 dB above this distortion: its estimate varies by some tenths


def test_filters_are_fitted_only_where_they_pay():
    fit = catalogue.find("speaker_nonlinearity").fit
    one = fit(*robot_alone("speaker_nonlinearity", {"odd": -0.5}))
    assert all(np.ndim(one[name]) == 0 for name in ("even", "odd", "saturation", "force_factor", "stiffness"))
    late = signal.firwin(9, 1500, fs=16_000) * 0.8
    several = fit(*robot_alone("speaker_nonlinearity", {"even": late}))
    assert np.size(several["even"]) > 1
    # what the fan lets through of a filter that reaches to 1.5 kHz
    assert np.dot(several["even"][:9], late) == pytest.approx(np.dot(late, late), rel=0.25)


@pytest.mark.parametrize("sizes", [[256], [1, 700, 13]])
def test_driven_hop_by_hop_is_the_same_as_at_once(sizes):
    x = robot_speech()[:20_000]
    knocks = {"threshold": 0.01, "resonance_hz": 250.0, "outward": np.array([0.0, 0.01, -0.02])}
    distortion = {"even": 0.3, "force_factor": np.array([0.5, 0.0, 0.4]), "stiffness": -2.0}
    model = (
        robot_model()
        .with_effect("speaker_nonlinearity", distortion)
        .with_effect("rattle", knocks)
        .with_effect("playback_gain", {"gain_db": 2.0})
    )
    whole = x
    for effect, values in catalogue.chain(model.effects):
        whole = effect.apply(whole, values, 16_000)
    driver, at, out = model.source_chain(), 0, []
    while at < x.size:
        size = sizes[len(out) % len(sizes)]
        out.append(driver(x[at : at + size]))
        at += size
    # the resonance's ringing beyond 1024 samples is 60 dB below the float's last digit but for rounding
    np.testing.assert_allclose(np.concatenate(out), whole, atol=1e-5)
    assert np.std(whole - x) > 1e-2


def test_driver_goes_on_after_its_past_was_rewritten():
    x, model = (
        robot_speech()[:8192],
        robot_model().with_effect("speaker_nonlinearity", {"stiffness": -2.0, "even": np.array([0.0, 0.3])}),
    )
    driver = model.source_chain()
    driver(np.full(256, 0.3, np.float32))
    history = driver.restart(x[:4096])
    again = [driver(x[at : at + 256]) for at in range(4096, x.size, 256)]
    whole = model.source_chain()(x)
    np.testing.assert_allclose(history, whole[:4096], atol=1e-6)
    np.testing.assert_allclose(np.concatenate(again), whole[4096:], atol=1e-6)
