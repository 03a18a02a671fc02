"""Hops and lessons go through shared memory unchanged."""

import numpy as np

from edgefilter.filter.canceller import Canceller
from edgefilter.filter.echo_path import EchoPath
from edgefilter.filter.learner import Heard, Lesson
from edgefilter.learning.shared import HOPS, SWITCHES, SharedHops


def hop(number, past=None):
    rng = np.random.default_rng(number)
    mic, reference, innovation = rng.standard_normal((3, 256)).astype(np.float32)
    return Heard(mic, reference, innovation, number % 2 == 0, number % 3 == 0, past, float(number))


def test_hops_arrive_as_they_were_also_when_the_ring_has_turned():
    ours = SharedHops(256, 1000)
    theirs = SharedHops(256, 1000, ours.name)
    ours.unlink()
    for number in range(HOPS + 10):
        past = np.full(1000, number, np.float32) if number % 100 == 0 else None
        ours.write(hop(number, past))
    assert theirs.written == HOPS + 10
    for number in (20, 500, 1000, HOPS + 9):
        sent, come = hop(number), theirs.read(number)
        for name in ("mic", "reference", "innovation", "located", "idle", "delay"):
            np.testing.assert_array_equal(getattr(come, name), getattr(sent, name))
    assert theirs.read(1000).past[0] == 1000
    assert theirs.read(999).past is None


def test_of_many_switches_the_latest_are_kept():
    ring = SharedHops(256, 8)
    ring.unlink()
    for number in range(3 * SWITCHES):
        ring.write(hop(number, np.full(8, number, np.float32)))
    assert ring.read(3 * SWITCHES - 1).past[0] == 3 * SWITCHES - 1
    assert ring.read(2 * SWITCHES).past[0] == 2 * SWITCHES


def test_a_lesson_is_taken_once_and_the_newest_counts():
    ours = SharedHops(256, 8)
    theirs = SharedHops(256, 8, ours.name)
    ours.unlink()
    assert ours.take() is None
    path = EchoPath(Canceller(taps=8192), (("speaker_nonlinearity", {"even": 0.5}),)).state()
    for detail in ("first", "second"):
        theirs.post(Lesson(path, "learned", detail))
    lesson = ours.take()
    assert lesson.detail == "second"
    np.testing.assert_array_equal(lesson.path.canceller.weights, path.canceller.weights)
    assert ours.take() is None


def test_figures_are_read_back():
    ring = SharedHops(256, 8)
    ring.unlink()
    assert ring.figures() == {}
    ring.report({"rounds": 3})
    assert ring.figures() == {"rounds": 3}
