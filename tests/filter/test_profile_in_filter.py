"""What a profile says is what the running filter does: its tail, its effects, and the path it learnt on the way."""

import numpy as np
import pytest
from scipy import signal

from edgefilter import EgoFilter, Profile, enhance
from edgefilter.types import PRE_ROLL
from tests.engines.test_engines import robot


def echo_of(profile, reference, delay=900):
    late = np.concatenate((np.zeros(delay - PRE_ROLL, np.float32), reference))[: reference.size]
    return profile.echo.predict(late)


def db(x):
    return 10 * np.log10(np.mean(np.square(x, dtype=np.float64)))


@pytest.fixture
def reference():
    noise = signal.lfilter([1], [1, -0.9], np.random.default_rng(5).standard_normal(64_000))
    return (0.05 * noise * (1 + np.sin(np.arange(noise.size) / 900))).astype(np.float32)


@pytest.mark.parametrize(("effect", "values"), [("speaker_nonlinearity", {"even": 2.0, "odd": 8.0}), ("playback_gain", {"gain_db": -9.0})])
def test_an_effect_in_the_profile_lowers_the_residual_of_a_robot_that_has_it(reference, effect, values):
    plain = robot()
    knowing = Profile(**{**plain.__dict__, "echo": plain.echo.with_effect(effect, values)})
    mic = echo_of(knowing, reference) + 1e-4 * np.random.default_rng(6).standard_normal(reference.size).astype(np.float32)
    aligned = slice(8_000, 24_000)
    without, with_it = (db(enhance(mic, reference, profile, "linear")[aligned]) for profile in (plain, knowing))
    assert with_it < without - 3  # the effect is known exactly; half the residual power is a modest ask, adaptation closes part of the gap


def test_the_tail_is_the_profiles_within_128_and_512_ms(reference):
    for taps, expected in ((600, 2048), (2048, 2048), (5000, 5120), (20_000, 8192)):
        profile = robot().with_impulse_response(np.r_[np.zeros(PRE_ROLL), 0.5, np.zeros(taps - PRE_ROLL - 1)].astype(np.float32))
        ego = EgoFilter(profile, "linear")
        assert ego.stats()["linear_stage"]["partitions"] * ego.hop == expected


def test_the_adapted_path_written_into_a_profile_starts_better_than_the_old_one(reference, tmp_path):
    rng = np.random.default_rng(9)
    old = robot()
    moved = old.echo.impulse_response.copy()
    moved[PRE_ROLL + 40 :] += 0.02 * rng.standard_normal(moved.size - PRE_ROLL - 40).astype(np.float32) * np.exp(-np.arange(moved.size - PRE_ROLL - 40) / 400)
    mic = echo_of(old.with_impulse_response(moved), reference) + 1e-4 * rng.standard_normal(reference.size).astype(np.float32)
    ego = EgoFilter(old, "linear")
    ego.process(mic, reference)
    ego.adapted_profile().save(tmp_path / "adapted.npz")
    start = slice(4_000, 12_000)
    before, after = (db(enhance(mic, reference, profile, "linear")[start]) for profile in (old, tmp_path / "adapted.npz"))
    assert after < before - 6  # four seconds of learning against none; 3 dB would already be a different path
