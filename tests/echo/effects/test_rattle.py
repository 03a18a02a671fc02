"""Rattle: when it knocks, how hard, with which sound, and what of it no model predicts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from edgefilter.echo.effect import complete
from edgefilter.echo.effects import catalogue
from edgefilter.echo.effects.rattle import find_knocks, resonated
from edgefilter.types import PRE_ROLL
from tests.conformance import fan, held_out_power, robot_alone, robot_model

RATTLE = catalogue.find("rattle")
SOUND = np.sin(np.arange(200) * 0.8) * np.exp(-np.arange(200) / 60)


def irregular_voice(n=192_000):
    """Noise around 150 Hz in bursts, with treble: every swing of the membrane is another."""
    rng = np.random.default_rng(3)
    low = signal.sosfilt(signal.butter(2, [80, 400], "band", fs=16_000, output="sos"), rng.standard_normal(n))
    bursts = 0.5 + 0.5 * np.sin(np.arange(n) / 2500)
    return (bursts * (0.5 * low / low.std() * 0.2 + 0.02 * rng.standard_normal(n))).astype(np.float32)


def test_a_knock_is_where_the_displacement_leaves_the_threshold_and_as_high_as_its_speed():
    moved = np.array([0, 0.5, 1.5, 2.0, 0.5, -0.5, -1.25, -1.5, 0], np.float32)
    outward, inward = find_knocks(moved, 1.0)
    # speeds of 1 and 0.75 per sample, 16 samples to the millisecond, over a threshold of 1
    assert np.flatnonzero(outward).tolist() == [2] and outward[2] == pytest.approx(16.0)
    assert np.flatnonzero(inward).tolist() == [6] and inward[6] == pytest.approx(12.0)


def test_the_membrane_resonates():
    t = np.arange(32_000) / 16_000
    peak = [
        np.abs(resonated(np.sin(2 * np.pi * hz * t).astype(np.float32), 200.0, 1.5)[16_000:]).max()
        for hz in (20, 200, 2000)
    ]
    assert peak[0] == pytest.approx(1.0, abs=0.02) and peak[1] == pytest.approx(1.5, abs=0.02) and peak[2] < 0.012


def test_fit_finds_what_sets_it_off_and_how_it_sounds():
    x, model = irregular_voice(), robot_model()
    truth = {"threshold": 0.12, "resonance_hz": 200.0, "q": 1.0, "outward": 0.02 * SOUND}
    base, _ = robot_alone()
    recording = model.with_effect("rattle", truth).predict(x) + fan(x.size)
    measurement = replace(base, reference=x, recording=recording)
    fitted = model.fit("rattle", measurement)
    found = dict(fitted.effects)["rattle"]
    # resonance, q and threshold trade against each other: near the resonance all three scale what is compared
    assert found["resonance_hz"] == pytest.approx(200.0, rel=0.1) and found["threshold"] == pytest.approx(
        0.12, rel=0.25
    )
    # another threshold is crossed some samples earlier or later: the sounds agree but for that shift
    agreement = (
        np.correlate(found["outward"], truth["outward"], "full")
        / np.linalg.norm(found["outward"])
        / np.linalg.norm(truth["outward"])
    )
    assert agreement.max() > 0.9 and abs(int(np.argmax(agreement)) - 199) <= 4
    before, after = held_out_power(measurement, model.predict(x)), held_out_power(measurement, fitted.predict(x))
    # knocks that barely cross the threshold are missed or invented
    assert before > 1.5 and after - 1 < 0.45 * (before - 1)


def test_variance_rings_after_each_knock_when_it_is_heard():
    x = np.zeros(8000, np.float32)
    x[1000:1400] = 0.5
    values = complete(RATTLE, {"threshold": 0.2, "power": 1e-4, "decay_ms": 5.0})
    variance = RATTLE.variance(x, values, 16_000)
    knock = int(np.flatnonzero(find_knocks(resonated(x, 200.0, 1.0), 0.2)[0])[0])
    assert variance[: knock + PRE_ROLL].max() == 0.0 and variance[knock + PRE_ROLL] > 0.0
    assert variance[knock + PRE_ROLL + 80] / variance[knock + PRE_ROLL] == pytest.approx(np.exp(-1), rel=0.01)
    assert not RATTLE.variance(x, complete(RATTLE, {}), 16_000).any()


def test_knocks_that_are_never_alike_go_into_the_variance():
    x, model = irregular_voice(), robot_model()
    knocks = find_knocks(resonated(x, 200.0, 1.0), 0.12)[0]
    rng = np.random.default_rng(8)
    wild = signal.lfilter([1], [1, -0.9], rng.standard_normal(x.size)) * np.sqrt(
        signal.lfilter([1], [1, -np.exp(-1 / 64)], np.roll(knocks, 64) ** 2)
    )
    base, _ = robot_alone()
    truth = {"threshold": 0.12, "resonance_hz": 200.0, "outward": 0.004 * SOUND}
    recording = model.with_effect("rattle", truth).predict(x) + fan(x.size) + (0.0004 * wild).astype(np.float32)
    measurement = replace(base, reference=x, recording=recording)
    values = complete(RATTLE, RATTLE.fit(measurement, model))
    assert 2.0 <= values["decay_ms"] <= 16.0  # 4 ms were simulated; the sound's imperfect estimate adds its own 4 ms
    left = recording - model.with_effect("rattle", values).predict(x) - fan(x.size)
    assert RATTLE.variance(x, values, 16_000).mean() == pytest.approx(np.mean(left**2), rel=0.5)


def test_noise_that_follows_the_voice_is_no_rattle():
    x, model = irregular_voice(), robot_model()
    base, _ = robot_alone()
    voice = model.predict(x)
    loudness = np.sqrt(signal.lfilter([0.01], [1, -0.99], voice.astype(float) ** 2))
    codec = (0.1 * loudness * np.random.default_rng(4).standard_normal(x.size)).astype(np.float32)
    measurement = replace(base, reference=x, recording=voice + codec + fan(x.size))
    assert held_out_power(measurement, voice) > 1.5
    assert RATTLE.fit(measurement, model)["threshold"] == 100.0


def test_the_model_says_where_and_at_which_frequencies_its_noise_is():
    x, power = irregular_voice(), np.zeros(16)
    power[4] = 1e-4
    model = (
        robot_model()
        .with_effect("rattle", {"threshold": 0.12, "power": power})
        .with_effect("playback_gain", {"gain_db": 6.0})
    )
    ((variance, colour),) = model.unpredictable(x)
    louder = RATTLE.variance(x * np.float32(10 ** (6 / 20)), dict(model.effects)["rattle"], 16_000)
    np.testing.assert_allclose(variance, louder)
    hz = np.arange(601) * 8000 / 600
    assert colour[
        (hz > 1999) & (hz < 2501)
    ].sum() > 0.999 * colour.sum() and colour.sum() * 8000 / 600 == pytest.approx(1.0, abs=0.06)
    assert robot_model().unpredictable(x) == ()
