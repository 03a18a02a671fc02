"""What is learned beside the running filter lowers what is left of the robot, and never costs the human anything."""

import numpy as np
import pytest

from edgefilter import EgoFilter, PathLearner, Profile, ProfileError, enhance
from edgefilter.filter.echo_path import starting_path
from edgefilter.learning.path_learner import CandidatePath
from edgefilter.session import level_db as db
from edgefilter.types import SAMPLE_RATE
from tests.learning.scenes import Scene, run


def seconds(x):
    return np.array([db(x[at : at + SAMPLE_RATE]) for at in range(0, x.size - SAMPLE_RATE + 1, SAMPLE_RATE // 2)])


def si_sdr(out, human):
    target = np.dot(out, human) / np.dot(human, human) * human
    return db(target) - db(out - target)


@pytest.fixture(scope="module")
def alone():
    return Scene(8.0)


@pytest.fixture(scope="module")
def taught(alone, tmp_path_factory):
    """What a filter that learns of that robot gave, the kinds of its events, the filter, closed, and the file that it wrote."""
    file = tmp_path_factory.mktemp("taught") / "robot.npz"
    out, kinds, ego = run(alone, PathLearner(remember=file))
    ego.close()
    return out, kinds, ego, file


@pytest.mark.slow
def test_a_distorting_loudspeaker_is_learned_from_its_first_seconds(alone, taught):
    plain, _, _ = run(alone)
    learned, kinds, ego, _ = taught
    assert "learned" in kinds
    assert db(learned[-4 * SAMPLE_RATE :]) < db(plain[-4 * SAMPLE_RATE :]) - 2.0
    assert ego.stats()["learning"]["learned"] == kinds.count("learned")
    assert not ego.can_adapt  # it began without a profile: there is none to write back


def test_the_first_lesson_knows_the_loudspeaker(alone):
    """After two seconds of the robot, some of which the search for its lag has cost."""
    ego = EgoFilter(engine="linear", learn=PathLearner())
    ego.process(alone.mic[: 4 * SAMPLE_RATE], alone.reference[: 4 * SAMPLE_RATE])
    updates = [event.detail for event in ego.events() if event.kind == "learned"]
    assert updates and updates[0].startswith("loudspeaker and path: ")


@pytest.mark.slow
def test_one_loud_sample_of_the_reference_does_not_end_the_learning(alone):
    reference = alone.reference.copy()
    reference[SAMPLE_RATE] = 1e6
    ego = EgoFilter(engine="linear", learn=PathLearner())
    ego.process(alone.mic[: 6 * SAMPLE_RATE], reference[: 6 * SAMPLE_RATE])
    assert ego.stats()["learning"]["heard_s"] > 2.0


@pytest.fixture(scope="module")
def again(alone, tmp_path_factory):
    """What the same gives in other blocks and with a file that cannot be written, and the filter."""
    out, _, ego = run(alone, PathLearner(remember=tmp_path_factory.mktemp("again") / "nowhere/robot.npz"), block=1111)
    return out, ego


@pytest.mark.slow
def test_the_same_recording_teaches_the_same_whatever_the_blocks(taught, again):
    np.testing.assert_array_equal(taught[0], again[0])


@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_told_of_at_the_end_and_no_sample_is_lost(alone, again):
    out, ego = again
    assert out.size == alone.mic.size
    with pytest.raises(ProfileError, match="nowhere"):
        ego.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "happens",
    [
        {"volume": 0.4},
        {"moved": 23},
        {"lag": 1700},
        {"ppm": 100.0},
        {"human_db": -10.0},
        {"human_db": 0.0, "repeats": True},
    ],
    ids=["volume", "moved", "lag", "drift", "human", "repeating human"],
)
def test_no_second_is_louder_than_without_learning(happens):
    scene = Scene(8.0, **happens)
    plain, _, _ = run(scene)
    learned, _, _ = run(scene, PathLearner())
    excess = seconds(learned - scene.human) - seconds(plain - scene.human)
    heard = seconds(plain - scene.human) > -60
    assert excess[heard].max() < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("repeats", [False, True])
def test_nothing_of_a_human_who_talks_all_the_time_is_learned(repeats):
    scene = Scene(8.0, human_db=-6.0, repeats=repeats)
    plain, _, _ = run(scene)
    learned, _, _ = run(scene, PathLearner())
    later = slice(4 * SAMPLE_RATE, None)
    assert si_sdr(learned[later], scene.human[later]) > si_sdr(plain[later], scene.human[later]) - 0.2


@pytest.mark.slow
def test_what_was_learned_is_better_to_begin_with_than_nothing(alone, taught):
    profile = Profile.load(taught[-1])
    assert profile.learned
    begin = slice(0, 3 * SAMPLE_RATE)
    cold, known = (enhance(alone.mic, alone.reference, p, engine="linear")[begin] for p in (None, profile))
    assert db(known) < db(cold) - 3.0


@pytest.mark.slow
def test_in_another_room_what_was_learned_is_no_worse_than_nothing_for_long(taught):
    profile = Profile.load(taught[-1])
    other = Scene(moved=29, seconds=24.0).part(12.0, 24.0)
    cold, _, _ = run(other)
    known, _, _ = run(other, PathLearner(profile), profile=profile)
    later = slice(8 * SAMPLE_RATE, None)
    assert db(known[later]) < db(cold[later]) + 1.0


def test_before_a_stream_begins_nothing_was_tried_and_nothing_learned():
    assert set(PathLearner().stats().values()) == {0}


def test_however_often_a_path_is_taken_over_only_a_few_run_beside_the_one_in_use():
    """A robot that is carried about all day has a update each time; each path that runs beside costs as much as the filter."""
    learner = PathLearner()
    learner.start(starting_path(None, 256).state(), 256)
    for _ in range(5):
        learner._compared += [
            CandidatePath(starting_path(None, 256), "path"),
            CandidatePath(starting_path(None, 256), "another path"),
        ]
        learner._adopt(learner._compared[-1])
        assert [candidate.was for candidate in learner._compared] in (
            ["the path before any learning"],
            ["the path before any learning", "the path of before"],
        )


@pytest.mark.slow
def test_too_little_of_the_robot_is_not_remembered(tmp_path):
    file = tmp_path / "robot.npz"
    short = Scene(seconds=2.2)
    _, _, ego = run(short, PathLearner(remember=file))
    ego.close()
    assert not file.exists()
