"""Effects of the echo model: neutral is nothing, each does what its physics says, and fitting finds it again."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from edgefilter.echo.effect import complete, neutral
from edgefilter.echo.effects import catalogue
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.model import EchoModel
from edgefilter.errors import UsageError
from edgefilter.types import PRE_ROLL


def speech(seconds: float = 4.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    n = int(seconds * 16000)
    level = 0.55 + 0.45 * np.sin(2 * np.pi * 3 * np.arange(n) / 16000)
    return (0.05 * level * signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))).astype(np.float32)


def model() -> EchoModel:
    h = np.zeros(400, np.float32)
    h[PRE_ROLL], h[PRE_ROLL + 150] = 0.5, 0.1
    return EchoModel(h)


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x, dtype=np.float64))))


@pytest.mark.parametrize("name", catalogue.names())
def test_neutral_values_change_nothing(name: str) -> None:
    x = speech(1.0)
    x.flags.writeable = False
    effect = catalogue.find(name)
    assert np.array_equal(effect.apply(x, neutral(effect), 16000), x)


@pytest.mark.parametrize(
    ("name", "values", "tolerance"),
    [
        ("playback_gain", {"gain_db": -2.5}, {"gain_db": 0.01}),  # least squares without noise: rounding only
        (
            "clock_drift",
            {"ppm": -80.0, "offset": 12.5},
            {"ppm": 3.0, "offset": 0.2},
        ),  # parabola through a coloured peak
    ],
)
def test_fit_finds_what_was_added(name: str, values: dict[str, float], tolerance: dict[str, float]) -> None:
    x, linear = speech(8.0), model()
    fitted = linear.fit(name, Measurement(x, linear.with_effect(name, values).predict(x)))
    found = dict(fitted.effects)[name]
    for key, allowed in tolerance.items():
        assert found[key] == pytest.approx(values[key], abs=allowed)


def test_fitted_compression_explains_most_of_a_compressor() -> None:
    x, linear = speech(), model()
    recording = linear.with_effect("compression", {"threshold_db": -24.0, "ratio": 4.0}).predict(x)
    fitted = linear.fit("compression", Measurement(x, recording)).predict(x)
    gain, plain = np.dot(recording, fitted) / np.dot(fitted, fitted), linear.predict(x)
    plain_gain = np.dot(recording, plain) / np.dot(plain, plain)
    # the grid's steps are 3 dB and a factor of 1.5: half of the deviation must go, whatever lies between the steps
    assert rms(recording - gain * fitted) < 0.5 * rms(recording - plain_gain * plain)


@pytest.mark.slow
def test_a_compressor_behind_a_turned_volume_is_fitted_to_what_it_gets() -> None:
    x, turned = speech(8.0), model().with_effect("playback_gain", {"gain_db": -12.0})
    truth = turned.with_effect("compression", {"threshold_db": -36.0, "ratio": 4.0})
    fitted = turned.fit("compression", Measurement(x, truth.predict(x)))
    left = rms(truth.predict(x) - fitted.predict(x)) / rms(truth.predict(x) - turned.predict(x))
    assert left < 0.3  # fitted to the voice as it was sent, it holds down what is 12 dB softer than its threshold: 1.0
    assert dict(fitted.effects)["compression"]["threshold_db"] == pytest.approx(-36.0, abs=3.0)


def test_compression_turns_down_the_loud_only() -> None:
    tone = np.sin(2 * np.pi * 500 * np.arange(32000) / 16000).astype(np.float32)
    compress = catalogue.find("compression")
    values = complete(compress, {"threshold_db": -20.0, "ratio": 2.0})
    quiet, loud = 0.05 * tone, 0.5 * tone
    assert rms(compress.apply(quiet, values, 16000)[16000:]) == pytest.approx(rms(quiet[16000:]), rel=1e-3)
    # 0.5 sin has a level of -9.03 dB, 10.97 dB above the threshold: half of that comes off; ripple of the 10 ms mean <
    # 0.3 dB
    change_db = 20 * np.log10(rms(compress.apply(loud, values, 16000)[16000:]) / rms(loud[16000:]))
    assert change_db == pytest.approx(-5.49, abs=0.3)


def test_drift_of_100_ppm_moves_a_tone_by_its_delay() -> None:
    n = np.arange(48000)
    tone = np.sin(2 * np.pi * 1000 * n / 16000).astype(np.float32)
    moved = catalogue.find("clock_drift").apply(tone, {"ppm": 100.0, "offset": 3.25}, 16000)
    expected = np.sin(2 * np.pi * 1000 * (n - 3.25 + 1e-4 * n) / 16000)
    # the 32-sample kernel is 70 dB clean at 1 kHz
    assert np.abs(moved - expected)[100:-100].max() < 1e-3


def test_components_add_up_to_the_prediction() -> None:
    x = speech(1.0)
    full = model().with_effect("speaker_nonlinearity", {"odd": -1.0}).with_effect("playback_gain", {"gain_db": 2.0})
    parts = full.components(x)
    assert list(parts) == ["linear", "speaker_nonlinearity", "playback_gain"]
    # three float32 additions
    np.testing.assert_allclose(sum(parts.values()), full.predict(x), atol=1e-6)
    assert rms(parts["speaker_nonlinearity"]) > 1e-4


def test_prediction_without_effects_is_the_convolution() -> None:
    x = speech(0.5)
    expected = np.convolve(x, model().impulse_response)[: x.size]
    np.testing.assert_allclose(model().predict(x), expected, atol=1e-6)  # float32 transform against direct sum


def test_filters_behind_the_path_are_applied_as_one_with_it() -> None:
    x = speech(2.0)
    values = {"bandlimit": {"cutoff_hz": 3000.0, "order": 6.0}, "equaliser": {"taps": np.eye(1, 90, 70)[0] * 0.3}}
    whole, one_by_one = model(), model().predict(x)
    for name, given in values.items():
        whole = whole.with_effect(name, given)
        one_by_one = catalogue.find(name).apply(one_by_one, complete(catalogue.find(name), given), 16000)
    inside = slice(1000, -1000)  # at the end the one by one hear no echo of what the recording cuts off
    assert rms((whole.predict(x) - one_by_one)[inside]) < 1e-4 * rms(one_by_one)


def test_what_is_added_to_the_response_comes_from_the_reference_and_an_older_filter_from_behind_the_path() -> None:
    x, h = speech(2.0), model().impulse_response
    added, taps = np.eye(1, 900, 700)[0] * 0.3, np.eye(1, 900, 732)[0] * 0.2
    changed = model().with_effect("early_path", {"added": added, "taps": taps})
    expected = np.convolve(x, h)[: x.size] + 0.3 * np.pad(x, (700, 0))[: x.size]
    expected += 0.2 * np.pad(np.convolve(x, h), (700, 0))[: x.size]
    np.testing.assert_allclose(changed.predict(x), expected, atol=1e-5)
    np.testing.assert_array_equal(changed.response(), changed.running_response()[: changed.response().size])


def test_with_effect_replaces_and_without_removes() -> None:
    one = model().with_effect("playback_gain", {"gain_db": 2.0}).with_effect("playback_gain", {"gain_db": 3.0})
    assert [(name, dict(values)) for name, values in one.effects] == [("playback_gain", {"gain_db": 3.0})]
    assert one.without_effect("playback_gain").effects == ()


def test_wrong_names_and_values_are_refused() -> None:
    with pytest.raises(UsageError, match="unknown effect 'wobble': choose one of"):
        model().with_effect("wobble", {})
    with pytest.raises(UsageError, match="no parameter 'gain': it takes gain_db"):
        model().with_effect("playback_gain", {"gain": 1.0})
    with pytest.raises(UsageError, match="ratio is 0.5"):
        model().with_effect("compression", {"ratio": 0.5})
