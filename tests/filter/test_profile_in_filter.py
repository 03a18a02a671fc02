"""What a profile says is what the running filter does: its tail, its effects, and the path it learnt on the way."""

import numpy as np
import pytest
from scipy import signal

from edgefilter import EgoFilter, Profile, enhance
from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel
from edgefilter.filter.canceller import Canceller
from edgefilter.filter.echo_path import EchoPath
from edgefilter.session import level_db as db
from edgefilter.types import PRE_ROLL
from tests.conformance import robot
from tests.diagnosis.robot_scene import profile, record, voice


def echo_of(profile, reference, delay=900):
    late = np.concatenate((np.zeros(delay - PRE_ROLL, np.float32), reference))[: reference.size]
    return profile.echo.predict(late)


def fan(n, rng):
    return 1e-4 * rng.standard_normal(n).astype(np.float32)


@pytest.fixture
def reference():
    noise = signal.lfilter([1], [1, -0.9], np.random.default_rng(5).standard_normal(64_000))
    return (0.05 * noise * (1 + np.sin(np.arange(noise.size) / 900))).astype(np.float32)


def test_a_robot_that_stands_elsewhere_is_aligned_by_its_path_of_today():
    """Whether a loud reflection is an effect of the profile or in its response, the output is the same to the bit."""
    reference, added = voice(8.0, seed=2), np.zeros(400)
    added[[PRE_ROLL, PRE_ROLL + 43]] = -0.1, 0.45
    elsewhere = profile().echo.with_effect("early_path", {"added": added})
    folded = EchoModel(elsewhere.response())
    mic = record(reference, folded)
    by_effect, by_response = (
        enhance(mic, reference, profile().with_echo(echo), engine="linear") for echo in (elsewhere, folded)
    )
    np.testing.assert_array_equal(by_effect, by_response)


def test_an_effect_in_the_profile_lowers_the_residual_of_a_robot_that_has_it(reference):
    plain = robot()
    knowing = plain.with_echo(plain.echo.with_effect("speaker_nonlinearity", {"even": 1.0, "odd": 1.0, "knee": 0.2}))
    mic = echo_of(knowing, reference) + fan(reference.size, np.random.default_rng(6))
    aligned = slice(2_000, 24_000)
    without, with_it = (db(enhance(mic, reference, profile, engine="linear")[aligned]) for profile in (plain, knowing))
    # the effect is known exactly; half the residual power is a modest ask, adaptation closes part of the gap
    assert with_it < without - 3


def test_the_adapted_path_written_into_a_profile_starts_better_than_the_old_one(reference, tmp_path):
    rng = np.random.default_rng(9)
    old = robot()
    moved = old.echo.impulse_response.copy()
    later = moved[PRE_ROLL + 40 :]
    later += 0.02 * rng.standard_normal(later.size).astype(np.float32) * np.exp(-np.arange(later.size) / 400)
    mic = echo_of(old.with_echo(EchoModel(moved)), reference) + fan(reference.size, rng)
    ego = EgoFilter(old, engine="linear")
    ego.process(mic, reference)
    ego.adapted_profile().save(tmp_path / "adapted.npz")
    start = slice(4_000, 12_000)
    before, after = (
        db(enhance(mic, reference, profile, engine="linear")[start]) for profile in (old, tmp_path / "adapted.npz")
    )
    assert after < before - 6  # four seconds of learning against none; 3 dB would already be a different path


def long_robot(taps=16_000, effects=(), decay=16_000):
    """A robot in a hall: its path decays by 60 dB within so many taps, by default twice what the linear stage holds."""
    rng = np.random.default_rng(3)
    path = np.zeros(taps, np.float32)
    n = np.arange(taps - PRE_ROLL)
    path[PRE_ROLL:] = 0.05 * rng.standard_normal(n.size) * np.exp(-n * 6.9 / decay)
    path[PRE_ROLL] = 0.6
    return robot().with_echo(EchoModel(path, effects))


def room(taps=12_000):
    """A late_reverb as it is fitted."""
    rng = np.random.default_rng(4)
    decay = 0.01 * np.exp(-np.arange(taps) / 3000)
    return "late_reverb", {"rt60_s": 0.8, "level_db": -10.0, "taps": decay * rng.standard_normal(taps)}


def test_the_path_behind_the_linear_stage_is_not_cut_off_where_it_is_written_back(reference, tmp_path):
    old = long_robot()
    ego = EgoFilter(old, engine="linear")
    held = ego.stats()["linear_stage"]["partitions"] * ego.hop
    assert held == 8192
    ego.process(echo_of(old, reference), reference)
    ego.adapted_profile().save(tmp_path / "adapted.npz")
    new = Profile.load(tmp_path / "adapted.npz").echo.impulse_response
    np.testing.assert_array_equal(new[held:], old.echo.impulse_response[held:])
    assert not np.array_equal(new[:held], old.echo.impulse_response[:held])


def test_path_effects_are_neither_lost_nor_applied_twice_where_the_path_is_written_back(reference):
    band = ("bandlimit", {"cutoff_hz": 5000.0, "order": 4.0, "phase": 0.0, "delay": 0.0, "taps": 0.0})
    old = long_robot(6_000, (("playback_gain", {"gain_db": -3.0}), room(), band))
    ego = EgoFilter(old, engine="linear")
    ego.process(np.zeros(8_000, np.float32), np.zeros(8_000, np.float32))  # nothing is heard, so nothing is learnt
    new = ego.adapted_profile()
    assert [name for name, _ in new.echo.effects] == ["playback_gain"]
    before, after = old.echo.running_response(), new.echo.running_response()
    assert before.size > 15_000  # the room reaches far behind the linear stage
    np.testing.assert_allclose(after, before, atol=1e-6)  # rounding of the stage's transforms, on a path of 0.6
    # what running_response leaves away is 80 dB under the path's peak at each tap, and the band limit's 64 samples
    # before it
    heard, still = old.echo.predict(reference), new.echo.predict(reference)
    assert db(still - heard) < db(heard) - 50
    twice = EgoFilter(new, engine="linear").adapted_profile().echo.running_response()
    np.testing.assert_allclose(twice, after, atol=1e-6)


def test_the_kept_end_of_the_path_follows_the_volume_that_was_turned(reference):
    old = long_robot()
    ego = EgoFilter(old, engine="linear")
    ego.process(np.float32(1.6) * echo_of(old, reference), reference)
    turned = 10 ** (ego.stats()["linear_stage"]["gain_db"] / 20)
    assert turned > 1.3
    new = ego.adapted_profile().echo.impulse_response
    np.testing.assert_allclose(new[8192:], turned * old.echo.impulse_response[8192:], rtol=1e-5)  # float32


def test_the_longest_path_with_reverberation_behind_it_can_still_be_written_back(tmp_path):
    old = long_robot(64_000, (room(),), decay=200_000)
    assert old.echo.running_response().size > 64_000
    EgoFilter(old, engine="linear").adapted_profile().save(tmp_path / "adapted.npz")
    assert Profile.load(tmp_path / "adapted.npz").echo.impulse_response.size == 64_000


def test_a_path_whose_delay_was_switched_goes_on_as_one_that_always_had_it() -> None:
    """Ahead of the path stands an effect that remembers what the robot said: a limiter."""
    effects = (("limiter", complete(find("limiter"), {"ceiling_db": -26.0, "release_ms": 400.0})),)
    rng, hop, at = np.random.default_rng(2), 256, 100
    moved = (0.1 * rng.standard_normal((at + 20) * hop) * np.repeat(rng.random(at + 20), hop)).astype(np.float32)
    response = np.eye(1, 2048, 40, dtype=np.float32)[0]
    silence = np.zeros(hop, np.float32)
    switched, always = (EchoPath(Canceller(hop, 2048, response), effects) for _ in range(2))
    for begin in range(0, at * hop, hop):
        switched.step(silence, silence, False)
        always.step(silence, moved[begin : begin + hop], False)
    predicted = []
    for hops in range(at, at + 20):
        here = slice(hops * hop, (hops + 1) * hop)
        past = moved[: here.stop] if hops == at else None
        steps = switched.step(silence, moved[here], False, past), always.step(silence, moved[here], False)
        predicted.append([-step.innovation for step in steps])
    assert np.abs(moved[at * hop :]).max() > 0.1 > np.abs(predicted).max() > 0.01  # it limits
    settled = predicted[1:]  # what the other delay has left in the canceller's shelf fades within some milliseconds
    np.testing.assert_allclose(*np.swapaxes(settled, 0, 1), atol=1e-5)
