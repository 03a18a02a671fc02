"""Effects of the path: each found again in a recording that was made by other means than the fit uses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from edgefilter.diagnosis.prepare import prepare
from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.fractional_delay import delayed
from edgefilter.echo.effects.late_reverb import EXPECTED
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.model import EchoModel
from edgefilter.echo.wiener import fit_filter
from edgefilter.types import PRE_ROLL
from tests.diagnosis.robot_scene import DELAY, FAN, path, profile, record, voice


def measure(recording: np.ndarray, x: np.ndarray) -> Measurement:
    psd = np.full(601, FAN**2 / 8000, np.float32)
    fit = np.arange(x.size) // 8000 % 2 == 0
    return Measurement(delayed(x, DELAY - PRE_ROLL), recording.astype(np.float32), psd, fit)


def excess_db(name: str, measurement: Measurement) -> tuple[float, dict]:
    model = EchoModel(path()).fit(name, measurement)
    white = measurement.whiten(measurement.recording - model.predict(measurement.reference))[~measurement.fit]
    return 10 * np.log10(np.mean(white.astype(float) ** 2)), dict(dict(model.effects)[name])


def test_the_long_filter_is_the_least_squares_one() -> None:
    rng = np.random.default_rng(0)
    x, h = rng.standard_normal(3000).astype(np.float32), rng.standard_normal(20)
    y = np.convolve(x, h)[4 : 4 + x.size].astype(np.float32) + 0.1 * rng.standard_normal(x.size).astype(np.float32)
    weights = (np.arange(x.size) // 500 % 2).astype(np.float32)
    columns = np.stack(
        [np.concatenate((np.zeros(24), x, np.zeros(24)))[24 + 4 - k : 24 + 4 - k + x.size] for k in range(20)], axis=1
    )
    expected = np.linalg.lstsq(columns * weights[:, None], y * weights, rcond=None)[0]
    np.testing.assert_allclose(
        fit_filter(x, y, weights, 20, 4, steps=40), expected, atol=1e-4
    )  # single-precision transforms


def in_an_office(seconds: float) -> Measurement:
    """The robot in a room with a reverberation time of 0.5 s."""
    rng, x = np.random.default_rng(4), voice(seconds)
    t = np.arange(10_000)
    room = np.pad(path(), (0, 6000))
    room[PRE_ROLL + 160 : PRE_ROLL + 160 + t.size] += (
        0.012 * rng.standard_normal(t.size) * 10 ** (-3 * t / (0.5 * 16000))
    )
    clean = signal.fftconvolve(delayed(x, DELAY - PRE_ROLL), room)[: x.size]
    return measure(clean + FAN * rng.standard_normal(x.size), x)


def test_late_reverberation_and_its_time_are_found() -> None:
    left, values = excess_db("late_reverb", in_an_office(12.0))
    assert left < 1.0  # the product's promise for linear effects
    assert values["rt60_s"] == pytest.approx(0.5, rel=0.2)  # the calibrated tail of 0.2 s is in it as well


def test_what_is_known_of_a_decaying_room_helps_where_little_was_heard() -> None:
    office, model = in_an_office(6.0), EchoModel(path())
    left, values = excess_db("late_reverb", office)
    scale = np.sqrt(np.sum(np.square(path(), dtype=float)))
    x = office.predicted(EchoModel(np.array([scale], np.float32)))[1]
    before = office.white_recording - office.predicted(model)[1]
    taps = values["added"].size
    flat = fit_filter(x, before, office.weights, taps, 0, prior=np.full(taps, EXPECTED), steps=40)
    with_flat = before - filtered(x, flat, 0)
    assert left < 10 * np.log10(np.mean(with_flat[~office.fit].astype(float) ** 2)) - 0.5


def test_a_resonance_is_found_with_its_frequency_and_q() -> None:
    rng, x = np.random.default_rng(5), voice(12.0)
    clean = EchoModel(path()).predict(delayed(x, DELAY - PRE_ROLL)).astype(float)
    ringing = clean + 0.8 * signal.lfilter(*signal.iirpeak(820.0, 40.0, fs=16000), clean)
    left, values = excess_db("chassis_resonance", measure(ringing + FAN * rng.standard_normal(x.size), x))
    assert values["frequency_hz"] == pytest.approx(820.0, rel=0.005)
    assert values["q"] == pytest.approx(40.0, rel=0.2)
    assert left < 0.5


def test_two_resonances_are_found_with_their_frequencies_loudest_first() -> None:
    rng, x = np.random.default_rng(5), voice(12.0)
    clean = EchoModel(path()).predict(delayed(x, DELAY - PRE_ROLL)).astype(float)
    ringing = clean + sum(
        gain * signal.lfilter(*signal.iirpeak(hz, 40.0, fs=16000), clean) for hz, gain in ((820.0, 0.5), (1900.0, 0.8))
    )
    left, values = excess_db("chassis_resonance", measure(ringing + FAN * rng.standard_normal(x.size), x))
    np.testing.assert_allclose(values["frequency_hz"], (1900.0, 820.0), rtol=0.005)
    assert left < 0.5


@pytest.mark.parametrize(
    "filters", [signal.butter(6, 3000.0, fs=16000, output="sos"), signal.cheby1(8, 0.5, 5000.0, fs=16000, output="sos")]
)
def test_a_low_pass_is_found_whatever_its_kind(filters: np.ndarray) -> None:
    rng, x = np.random.default_rng(6), voice(12.0)
    clean = signal.sosfilt(filters, EchoModel(path()).predict(delayed(x, DELAY - PRE_ROLL)).astype(float))
    recording = (clean + FAN * rng.standard_normal(x.size)).astype(np.float32)
    left, values = excess_db("bandlimit", prepare(profile(), recording, x).measurement)  # takes out the filter's delay
    hz, response = signal.sosfreqz(filters, 4096, fs=16000)
    half_power = hz[np.flatnonzero(np.abs(response) > 0.707)[-1]]
    assert values["cutoff_hz"] == pytest.approx(half_power, rel=0.15)  # a ripple filter is no Butterworth filter
    assert left < 1.0


def test_a_changed_path_is_found_with_its_time() -> None:
    x = voice(16.0)
    before, after = record(x), record(x, EchoModel(delayed(path(seed=2), 0.4)))
    left, values = excess_db("path_change", measure(np.where(np.arange(x.size) < 7.0 * 16000, before, after), x))
    assert values["time_s"] == pytest.approx(7.0, abs=0.15)  # the next sound after it
    assert left < 1.0


def somewhere(seed: int) -> np.ndarray:
    """A response in a room with a reverberation time of 0.25 s, which is half as loud as the direct sound, (4000,)."""
    rng, t = np.random.default_rng(seed), np.arange(4000 - PRE_ROLL - 20)
    response, tail = np.zeros(4000), rng.standard_normal(t.size) * 10 ** (-3 * t / (0.25 * 16000))
    response[PRE_ROLL], response[PRE_ROLL + 20 :] = 0.1, 0.05 * tail / np.sqrt(np.sum(tail**2))
    return response.astype(np.float32)


@pytest.mark.parametrize("name", ["early_path", "path_change"])
def test_a_robot_that_was_moved_is_explained_though_no_short_filter_turns_one_place_into_the_other(name: str) -> None:
    x, rng = delayed(voice(16.0), DELAY - PRE_ROLL), np.random.default_rng(7)
    there, here = (signal.fftconvolve(x, somewhere(seed))[: x.size] for seed in (1, 2))
    moved = here if name == "early_path" else np.where(np.arange(x.size) < 8.0 * 16000, there, here)
    measurement = measure(moved + FAN * rng.standard_normal(x.size), voice(16.0))
    model = EchoModel(somewhere(1)).fit(name, measurement)
    left = measurement.whiten(measurement.recording - model.predict(measurement.reference))[~measurement.fit]
    assert 10 * np.log10(np.mean(left.astype(float) ** 2)) < 1.0
    np.testing.assert_allclose(model.running_response()[:2000], somewhere(2)[:2000], atol=0.005)


def test_a_changed_path_is_faded_over_to_and_goes_through_the_filters_behind_it() -> None:
    x, added = voice(3.0), np.eye(1, 300, 200)[0] * 0.1
    band = {"cutoff_hz": 4000.0, "order": 6.0, "phase": 1.0}
    old = EchoModel(path()).with_effect("bandlimit", band)
    new = old.with_effect("early_path", {"added": added})
    change = old.with_effect("path_change", {"time_s": 1.5, "duration_s": 1.0, "added": added})
    share = np.clip(np.arange(x.size) / 16000 - 1.0, 0.0, 1.0)
    expected = (1.0 - share) * old.predict(x) + share * new.predict(x)
    np.testing.assert_allclose(change.predict(x), expected, atol=2e-5 * np.abs(expected).max())
    never = change.with_effect("path_change", {"added": added})
    np.testing.assert_allclose(never.predict(x), old.predict(x), atol=1e-6)


def test_what_runs_is_the_path_with_its_stationary_effects() -> None:
    x = voice(3.0)
    model = EchoModel(path())
    resonance = {"frequency_hz": 900.0, "q": 20.0, "gain_db": -3.0}
    full = model.with_effect("chassis_resonance", resonance).with_effect(
        "bandlimit", {"cutoff_hz": 4000.0, "order": 6.0, "phase": 1.0}
    )
    running = EchoModel(full.running_response()).predict(x)
    whole = slice(0, x.size - PRE_ROLL)  # the low-pass rings ahead of sounds that the recording no longer holds
    np.testing.assert_allclose(
        running[whole], full.predict(x)[whole], atol=2e-4 * np.abs(running).max()
    )  # the ring is cut 80 dB down
    assert model.running_response() is model.impulse_response
    assert full.with_running_response(full.running_response()).effects == ()


def test_the_new_path_runs_after_a_change() -> None:
    taps = np.zeros(200)
    taps[64] = 0.5
    change = EchoModel(path()).with_effect("path_change", {"time_s": 9.0, "taps": taps})
    np.testing.assert_allclose(change.running_response()[:6400], 1.5 * path(), atol=1e-6)


def test_reverberation_lengthens_the_running_filter() -> None:
    taps = np.zeros(9000)
    taps[8000] = 0.3
    running = (
        EchoModel(path())
        .with_effect("late_reverb", {"taps": taps, "rt60_s": 0.5, "level_db": -10.0})
        .running_response()
    )
    assert running.size > 8000 + PRE_ROLL - 32
    assert profile(running).echo.impulse_response.size == running.size


def test_an_echo_of_some_milliseconds_is_no_longer_room() -> None:
    """In a dry room it falls by 20 dB later then; the reflections come twice, and no later in the mean."""
    x, echo = voice(8.0), np.zeros(160)
    echo[[0, 102, 115, 119]] = 1.0, 0.2, 0.17, 0.39  # 6.4, 7.2 and 7.4 ms
    dry = np.where(np.arange(path().size) > PRE_ROLL + 16, 0.3, 1.0) * path()
    room = EchoModel(np.pad(dry, (0, 1600)).astype(np.float32))
    heard = np.convolve(room.predict(delayed(x, DELAY - PRE_ROLL)), echo)[: x.size]
    measurement = measure(heard + FAN * np.random.default_rng(4).standard_normal(x.size), x)
    late, early = (room.fitted(name, measurement) for name in ("late_reverb", "early_path"))
    assert late["level_db"] == -120.0 and not np.any(late["added"])
    assert early["within_ms"] < 9.0


def test_reflections_that_are_louder_up_to_60_ms_are_no_longer_room() -> None:
    x, there = delayed(voice(12.0), DELAY - PRE_ROLL), somewhere(1)
    here, direct = there.copy(), int(np.argmax(np.abs(there)))
    here[direct + 320 : direct + 960] *= 2.0
    heard = signal.fftconvolve(x, here)[: x.size] + FAN * np.random.default_rng(5).standard_normal(x.size)
    moved, model = measure(heard.astype(np.float32), voice(12.0)), EchoModel(there)
    late, early = (model.fitted(name, moved) for name in ("late_reverb", "early_path"))
    assert late["level_db"] == -120.0 and early["level_db"] > -30.0
