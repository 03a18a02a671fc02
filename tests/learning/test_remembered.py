"""What a learner keeps in its file: only what is better to begin with, on hops that came after it was learned."""

from dataclasses import replace

import numpy as np
import pytest

from edgefilter import PathLearner, Profile
from edgefilter.echo.model import EchoModel
from edgefilter.filter.echo_path import FilteredHop, starting_path
from edgefilter.session import level_db as db
from edgefilter.types import PRE_ROLL, SAMPLE_RATE
from tests.learning.scenes import Scene, room, run

HOP = 256


def calibrated(seed):
    flat = np.ones(601, np.float32)
    bands, snr, distortion = np.array([[900.0, 1100.0]]), np.array([40.0]), np.full(4, -50.0)
    return Profile(EchoModel(room(seed)), 0.0, flat, 1e-12 * flat, bands, snr, distortion, source="a sweep")


def learned_in(rooms, profile, file):
    """Let a learner that began with the profile follow a robot through rooms: (seed, seconds)."""
    rng = np.random.default_rng(0)
    n = sum(int(seconds * SAMPLE_RATE) for _, seconds in rooms)
    reference = (0.1 * rng.standard_normal(n)).astype(np.float32)
    mic, begin = 1e-4 * rng.standard_normal(n).astype(np.float32), 0
    for seed, seconds in rooms:
        span = slice(begin, begin := begin + int(seconds * SAMPLE_RATE))
        mic[span] += np.convolve(reference, room(seed))[span]
    path, learner = starting_path(profile, HOP), PathLearner(profile, file)
    learner.start(path.state(), HOP)
    for at in range(0, n - HOP + 1, HOP):
        heard, said = mic[at : at + HOP], reference[at : at + HOP]
        learner.observe(FilteredHop(heard, said, path.step(heard, said, True).innovation, True, False, None, 0.0))
    learner.close()
    return learner.stats()


@pytest.mark.slow
@pytest.mark.parametrize("profile", [None, calibrated(23)], ids=["from nothing", "from a calibration"])
def test_the_room_that_the_robot_stays_in_is_kept_as_learned(tmp_path, profile):
    assert learned_in([(2, 6.0)], profile, tmp_path / "robot.npz")["remembered"] > 0
    assert Profile.load(tmp_path / "robot.npz").learned


@pytest.mark.slow
def test_a_room_that_the_robot_has_left_is_not_kept(tmp_path):
    """It is better on the seconds that it was learned from, and worse on most that came later."""
    learned_in([(2, 2.4), (23, 2.5)], calibrated(23), tmp_path / "robot.npz")
    assert not (tmp_path / "robot.npz").exists()


@pytest.mark.slow
def test_what_no_later_hop_has_confirmed_is_not_kept(tmp_path):
    learned_in([(2, 2.4)], calibrated(23), tmp_path / "robot.npz")
    assert not (tmp_path / "robot.npz").exists()


@pytest.mark.slow
def test_what_is_kept_is_the_room_and_its_fan_and_is_left_sooner_than_what_was_measured(tmp_path):
    _, _, ego = run(Scene(moved=23, seconds=24.0).part(12.0, 20.0), PathLearner(None, tmp_path / "robot.npz"))
    ego.close()
    learned = Profile.load(tmp_path / "robot.npz")
    path, true = learned.echo.impulse_response[PRE_ROLL:], room(23)
    assert db(path[: true.size] - true) < db(true) - 20.0  # of a loudspeaker that distorts by -20 dB
    assert dict(learned.echo.effects).keys() == {"speaker_nonlinearity"}
    fan = 10 * np.log10(learned.noise_psd / (1e-8 / 8000))
    assert abs(np.median(fan)) < 1.0 and np.abs(np.percentile(fan, [5, 95])).max() < 3.0
    assert 40.0 < learned.band_snr_db.min() and learned.band_snr_db.max() < 75.0
    elsewhere = Scene(seconds=8.5)  # a path that fits nowhere is given up once all lags were searched
    last = [run(elsewhere, profile=p)[0][-SAMPLE_RATE:] for p in (learned, replace(learned, source="a sweep"))]
    assert db(last[0]) < db(last[1]) - 3.0
