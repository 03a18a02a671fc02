"""Learning in another process: the same lessons, late, and a filter that does without them where it must."""

import signal
import time

import numpy as np
import pytest

from edgefilter import BackgroundLearner, EgoFilter, PathLearner, Profile
from tests.learning.scenes import Scene

HOP = 256


def caught_up(learner, hops):
    deadline = time.monotonic() + 60
    while learner.stats().get("hops", 0) < hops:
        assert time.monotonic() < deadline, learner.stats()
        assert learner.stats()["process"] == "running"
        time.sleep(0.02)


def feed(ego, learner, scene, every=100):
    """The whole scene, waiting for the learner now and then, as real time would."""
    out = []
    for count, at in enumerate(range(0, scene.mic.size - HOP + 1, HOP), start=1):
        out.append(ego.process(scene.mic[at : at + HOP], scene.reference[at : at + HOP]))
        if count % every == 0:
            caught_up(learner, count)
    return np.concatenate(out)


@pytest.fixture(scope="module")
def scene():
    return Scene(seconds=10.0)


def test_it_learns_what_the_learner_in_this_process_does(scene, tmp_path):
    file = tmp_path / "robot.npz"
    learner = BackgroundLearner(remember=file)
    ego = EgoFilter(engine="linear", learn=learner)
    out = feed(ego, learner, scene)
    kinds = [event.kind for event in ego.events()]
    assert "learned" in kinds
    for number in (signal.SIGINT, signal.SIGTERM):  # Ctrl-C and a stopped service reach the whole group
        learner._process.send_signal(number)
    stats = ego.stats()["learning"]
    assert stats["cpu_s"] > 0
    assert stats["memory_mb"] > 0
    alone = EgoFilter(engine="linear")
    plain = alone.process(scene.mic, scene.reference)
    last = slice(out.size - 16_000, out.size)
    assert np.mean(out[last] ** 2) < 0.8 * np.mean(plain[last] ** 2)
    ego.close()
    assert learner.stats()["process"] == "ended"
    assert Profile.load(file).learned


def test_the_filter_goes_on_where_the_learner_has_died(scene):
    learner = BackgroundLearner()
    ego = EgoFilter(engine="linear", learn=learner)
    learner._process.kill()
    learner._process.wait()
    out = np.concatenate((ego.process(scene.mic, scene.reference), ego.flush()))
    plain = EgoFilter(engine="linear")
    np.testing.assert_allclose(
        out, np.concatenate((plain.process(scene.mic, scene.reference), plain.flush())), atol=1e-5
    )
    assert ego.stats()["learning"]["process"] == "ended"
    ego.close()


def test_a_learner_that_was_never_started_closes_in_silence():
    for learner in (BackgroundLearner(), PathLearner()):
        learner.close()
        ego = EgoFilter(engine="bypass", learn=learner)
        assert ego.stats()["learning"] is None
        ego.close()
