"""Stationary linear changes are told apart: a colour, a path that is another from the start, and a room that sounds longer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from edgefilter.diagnosis.recording import Recording, diagnose
from edgefilter.dsp.fractional_delay import delayed
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel
from edgefilter.types import PRE_ROLL
from tests.diagnosis.robot_scene import DELAY, FAN, path, profile, record, voice

RATE = 16000
SHELF_HZ = 2500.0


def through(h: np.ndarray, x: np.ndarray) -> np.ndarray:
    """What the microphone hears through that path, with the fan."""
    clean = EchoModel(h.astype(np.float32)).predict(delayed(x, DELAY - PRE_ROLL))
    return (clean + FAN * np.random.default_rng(3).standard_normal(x.size)).astype(np.float32)


def shelf(gain_db: float) -> tuple[np.ndarray, np.ndarray]:
    """Of first order: 0 dB at low frequencies, gain_db in the treble."""
    turn = 2 * np.pi * SHELF_HZ
    return signal.bilinear([10 ** (gain_db / 20), turn], [1.0, turn], RATE)


def bell(hz: float, q: float, gain_db: float) -> tuple[np.ndarray, np.ndarray]:
    """One band of a parametric equaliser."""
    a, w = 10 ** (gain_db / 40), 2 * np.pi * hz
    return signal.bilinear([1.0, w * a / q, w * w], [1.0, w / (a * q), w * w], RATE)


def three_reflections() -> np.ndarray:
    """Within 6 ms, as of a table that the robot was put on."""
    taps = np.zeros(97)
    taps[[0, 18, 41, 96]] = 1.0, 0.3, -0.25, 0.2
    return np.convolve(path(), taps)[:6400]


def elsewhere() -> np.ndarray:
    """Another place in the same room: all reflections are others, and die away as they did."""
    h = path(seed=5)
    h[PRE_ROLL + 23] += 0.1
    return h


def longer_room() -> np.ndarray:
    rng, h = np.random.default_rng(4), np.pad(path(), (0, 6000))
    t = np.arange(10_000)
    h[PRE_ROLL + 160 :][: t.size] += 0.012 * rng.standard_normal(t.size) * 10 ** (-3 * t / (0.5 * RATE))
    return h


def assert_gain_of_the_shelf(values: Values) -> None:
    """The gain is read over frequency."""
    impulse = np.eye(1, 4096, 1024, dtype=np.float32)[0]
    response = np.abs(np.fft.rfft(find("equaliser").apply(impulse, values, RATE)))
    hz, wanted = signal.freqz(*shelf(-4.0), response.size, fs=RATE)
    heard = (hz > 200) & (hz < 6000)
    error_db = 20 * np.log10(response[heard] / np.abs(wanted[heard]))
    assert np.abs(error_db).max() < 0.5  # ten seconds of a voice that is 20 dB down at 6 kHz


SHELVED = signal.lfilter(*shelf(-4.0), path())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("h", "named"),
    [
        (three_reflections(), "early_path"),
        (elsewhere(), "early_path"),
        (SHELVED, "equaliser"),
        (signal.lfilter(*shelf(-13.0), path()), "equaliser"),
        (signal.lfilter(*bell(900.0, 3.0, 5.0), path()), "equaliser"),
        (signal.lfilter(*bell(900.0, 25.0, 12.0), path()), "chassis_resonance"),
        (longer_room(), "late_reverb"),
    ],
    ids=[
        *("three reflections within 6 ms", "elsewhere in the room", "treble shelf of -4 dB", "of -13 dB"),
        *("a band of Q 3", "a ring of Q 25", "a room of 0.5 s"),
    ],
)
def test_a_stationary_change_is_named_as_what_it_is(h: np.ndarray, named: str) -> None:
    x = voice(6.0)
    found = diagnose(profile(), through(h, x), x)
    assert (found.verdict, [finding.effect for finding in found.ranking]) == ("missing", [named])
    assert found.remaining_db < 1.0  # the product's promise for linear effects
    if h is SHELVED:
        assert_gain_of_the_shelf(found.ranking[0].values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("h", "beside", "turned_db"),
    [
        (longer_room(), "late_reverb", 3.0),
        (signal.lfilter(*signal.butter(6, 2000.0, fs=RATE), path()), "bandlimit", -2.0),
    ],
    ids=["a room of 0.5 s", "a band limit"],
)
def test_a_turned_volume_is_named_beside_a_filter_that_could_take_it_up(
    h: np.ndarray, beside: str, turned_db: float
) -> None:
    x = voice(6.0)
    found = diagnose(profile(), through(10 ** (turned_db / 20) * h, x), x)
    assert (found.verdict, {finding.effect for finding in found.ranking}) == ("missing", {beside, "playback_gain"})
    volume = next(finding for finding in found.ranking if finding.effect == "playback_gain")
    assert volume.values["gain_db"] == pytest.approx(turned_db, abs=0.3)


def test_beside_a_drift_an_effect_is_fitted_to_a_recording_without_it() -> None:
    x, drift = voice(7.0), {"ppm": 200.0, "offset": 3.0}
    robot = EchoModel(SHELVED.astype(np.float32)).with_effect("clock_drift", drift)
    recording = Recording(record(x, robot), x, profile()).straightened
    model = recording.model.with_effect("clock_drift", recording.fitted("clock_drift", recording.model))
    assert_gain_of_the_shelf(recording.fitted("equaliser", model))
    assert vanishes(find("bandlimit"), recording.fitted("bandlimit", model))  # reading between samples takes no treble


@pytest.mark.slow
def test_a_band_limit_is_named_where_knocks_are_louder_than_what_it_takes_away() -> None:
    x = voice(12.0)
    level = signal.lfilter([0.002], [1.0, -0.998], np.square(x, dtype=float))
    knocks = 0.04 * level / level.max() * np.random.default_rng(7).standard_normal(x.size)
    heard = through(signal.lfilter(*signal.butter(6, 2000.0, fs=RATE), path()), x) + knocks
    found = diagnose(profile(), heard.astype(np.float32), x)
    assert (found.verdict, {finding.effect for finding in found.ranking}) == ("missing", {"bandlimit", "rattle"})
