"""Short bursts of the robot's own voice count against later ones, but not where a human has just spoken."""

from edgefilter.filter.own_bursts import OwnBursts

HOP_S, LEVEL = 0.016, 3.0


def doubts(pattern):
    """The greatest doubt over 40 s in which the pattern of (hops, odds) repeats while the robot speaks."""
    robot = OwnBursts(HOP_S, LEVEL)
    odds = [value for hops, value in pattern for _ in range(hops)]
    return max(robot.step(odds[hop % len(odds)], robot=True) for hop in range(2500))


def test_a_burst_a_second_is_doubted():
    assert doubts([(5, 5.0), (60, -2.0)]) == 1.0


def test_bursts_within_a_second_of_somebody_who_speaks_are_theirs():
    word, pause, syllable = (30, 5.0), (20, -2.0), (5, 5.0)  # 0.5 s, 0.3 s, 0.1 s
    assert doubts([word, pause, syllable, pause]) == 0.0


def test_a_burst_a_good_second_from_any_speech_counts():
    far = (90, -2.0)  # 1.4 s on both sides
    assert doubts([(30, 5.0), far, (5, 5.0), far]) > 0.0
