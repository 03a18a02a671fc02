"""What effects mean for the prediction, for the fan and for what is expected to be left, in the parts of the running filter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from edgefilter.dsp.stft import StftConfig
from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.running import SourceChain, VoiceChain
from edgefilter.filter.canceller import Canceller
from edgefilter.filter.residual_echo import Residual, Unpredictable
from edgefilter.session import level_db as db
from tests.conformance import robot_model, robot_speech, running_robot
from tests.filter.canceller_scene import path, run, speechlike

STFT = StftConfig()


def test_expected_squares_become_the_power_that_such_noise_has_in_a_frame() -> None:
    rng = np.random.default_rng(1)
    square = np.repeat([0.0, 4.0, 1.0, 0.25], 128).astype(np.float32)
    low = np.where(np.arange(601) < 150, 1 / 2000, 0.0)  # 0 to 2 kHz
    white = np.sqrt(square) * rng.standard_normal((4000, 512))
    heard = np.mean(np.abs(np.fft.rfft(white * STFT.analysis_window)) ** 2, axis=0)
    expected = Unpredictable(STFT, [np.full(601, 1 / 8000), low])
    for part in (square[:256], square[256:]):
        found = expected.step([part, np.zeros(256, np.float32)])
    # the mean of 4000 frames is known to 1.6 %, at either end to 2.2
    np.testing.assert_allclose(found, heard, rtol=0.15)
    coloured = Unpredictable(STFT, [low])
    for part in (square[:256], square[256:]):
        found = coloured.step([part])
    assert found[:60] == pytest.approx(4 * np.mean(heard[1:-1]), rel=0.05) and not found[70:].any()


def test_what_no_waveform_predicts_is_expected_to_be_left_and_not_learnt_as_leakage() -> None:
    rng = np.random.default_rng(2)
    echo, knocks = (rng.standard_normal((200, 257)) + 1j * rng.standard_normal((200, 257)) for _ in range(2))
    added, nothing = np.full(257, 0.2, np.float32), np.zeros(257, np.float32)
    told, untold = Residual(STFT), Residual(STFT)
    speaks = np.arange(200)[:, None] % 10 >= 5  # what never pauses would be noise
    for e, k in zip(*(speaks * np.complex64((echo, np.sqrt(0.1) * knocks))).astype(np.complex64)):
        _, knowing = told.step(e, k, nothing, added)
        _, without = untold.step(e, k, nothing)
    leakage = knowing.mean() - 0.2
    # who is not told takes it for leakage, and learns more of that every hop
    assert 0.0 < leakage < 0.3 * without.mean()


def test_a_microphone_that_clips_does_not_teach_the_canceller_another_path() -> None:
    x, h = 4 * speechlike(6.0), path()
    voice = signal.oaconvolve(x, h)[: x.size].astype(np.float32)
    level = float(np.quantile(np.abs(voice), 0.95))
    values = {"level": level}
    effect = find("mic_clipping")
    model = robot_model().with_effect("mic_clipping", values)
    mic = effect.apply(voice, complete(effect, values), 16_000)
    plain, knowing = Canceller(256, 3072, h), Canceller(256, 3072, h)
    knowing.behind = VoiceChain(model.effects)
    left = [db(run(canceller, mic, x)) for canceller in (plain, knowing)]
    assert left[1] < left[0] - 20  # the path is known exactly: nothing but rounding and the limiter's caution is left
    off = [db(canceller.impulse_response()[: h.size] - h) for canceller in (plain, knowing)]
    assert off[1] < off[0] - 10


def test_a_gain_control_is_followed_and_takes_nothing_of_the_human() -> None:
    x = robot_speech()[: 8 * 16_000]
    moving = 10 ** (3 * np.sin(np.arange(x.size) / 16_000 * 4) / 20)
    human = 0.02 * robot_speech(8.0, seed=9)[::-1]  # backwards, or it would have the robot's pitch
    values = complete(find("mic_agc"), {"gain_db": np.zeros(4), "range_db": 6.0, "time_constant_s": 0.4})

    def left(heard: np.ndarray) -> np.ndarray:
        follower = find("mic_agc").run(values, 16_000)
        hops = range(0, x.size, 256)
        return heard - np.concatenate([follower(x[at : at + 256], heard[at : at + 256]) for at in hops])

    voice = (moving * x).astype(np.float32)
    alone, with_human = left(voice), left(voice + human)
    assert db(alone) < db(voice - x) - 20  # without the follower the gain's movement is left
    assert db(with_human - alone - human) < db(human) - 10


def test_a_gain_control_that_stood_still_is_not_followed() -> None:
    assert not VoiceChain([("mic_agc", {"gain_db": 2.0, "range_db": 0.1})])


def test_a_changed_fan_is_the_fan_that_is_expected() -> None:
    _, _, profile = running_robot("playback_gain", {"gain_db": -1.0})
    louder = profile.with_echo(profile.echo.with_effect("fan_noise", {"spectrum_db": np.full(601, 6.0)}))
    np.testing.assert_allclose(louder.noise_bins(STFT), 10**0.6 * profile.noise_bins(STFT), rtol=1e-5)


def test_knocks_are_expected_where_the_reference_sets_them_off() -> None:
    x = robot_speech()[32_000:64_000]
    model = robot_model().with_effect("rattle", {"threshold": 0.02, "power": 1e-3, "decay_ms": 4.0})
    ((whole, colour),) = model.unpredictable(x)
    source = SourceChain(model.effects)
    found = []
    for at in range(0, x.size, 256):
        source(x[at : at + 256])
        found.append(source.expected[0])
    np.testing.assert_array_equal(source.colours[0], colour)
    # the window holds 128 ms of the past, of which a resonance of Q 1 and a ringing of 4 ms leave nothing
    np.testing.assert_allclose(np.concatenate(found), whole, atol=1e-5 * whole.max())
    assert whole.max() > 0.0
