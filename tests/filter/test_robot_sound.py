"""By level and colour the robot is known again without a reference, and nobody else is taken for it."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.filter.robot_sound import RobotSound

HOP, BINS = 256, 257
HOPS = 16000 / HOP
"""A second."""
NOTHING = np.zeros(BINS, np.float32)
COLOUR = np.exp(-np.arange(BINS) / 40).astype(np.float32)


def sound(seconds: float, colour: np.ndarray = COLOUR, seed: int = 0) -> np.ndarray:
    """Powers (hops, bins) of a voice of that colour, in syllables."""
    rng = np.random.default_rng(seed)
    return (colour * rng.exponential(1.0, (round(seconds * HOPS), BINS))).astype(np.float32)


def heard(other: np.ndarray, known_s: float = 10.0, noise: np.ndarray = NOTHING) -> list[bool]:
    """What is said of another sound, one verdict after the other, when so many seconds of robot are known."""
    robot = RobotSound(HOP, BINS)
    for power in sound(known_s, seed=1) + noise:
        robot.learn(power)
    return [said for power in other if (said := robot.compare(power, noise)) is not None]


def test_the_robot_is_known_again_every_four_seconds_and_a_voice_of_another_level_or_colour_is_not() -> None:
    assert heard(sound(12.5)) == [True] * 3
    assert heard(10 ** (-7 / 10) * sound(4.5)) == heard(10 ** (7 / 10) * sound(4.5)) == [False]
    assert heard(sound(4.5, COLOUR * np.where(np.arange(BINS) % 40 < 20, 10.0, 0.1))) == [False]


def test_a_robot_that_is_turned_by_3_db_is_still_the_robot() -> None:
    assert heard(0.5 * sound(4.5)) == heard(2.0 * sound(4.5)) == [True]


@pytest.mark.parametrize(("known_s", "said"), [(2.0, []), (5.0, [True])])
def test_nothing_is_said_before_enough_of_the_robot_was_heard(known_s: float, said: list[bool]) -> None:
    assert heard(sound(4.5), known_s) == said


def test_pauses_are_no_sound() -> None:
    spoken = sound(8.5)
    spoken[np.arange(len(spoken)) % 20 < 10] *= 1e-4
    assert heard(spoken) == [True]


def test_of_bands_in_the_noise_nothing_is_compared() -> None:
    """A fan hides the upper half, in which the two differ by 20 dB."""
    fan = np.where(np.arange(BINS) > 100, 1.0, 1e-6).astype(np.float32)
    dull = sound(4.5, COLOUR * np.where(np.arange(BINS) > 100, 0.01, 1.0))
    assert heard(dull) == [False]
    assert heard(dull + fan, noise=fan) == [True]
    fan = np.where(np.arange(BINS) > 40, 1.0, 1e-6).astype(np.float32)  # nor do they count for those that are heard
    assert heard(10 ** (-7 / 10) * sound(4.5) + fan, noise=fan) == [False]


def test_the_robot_is_as_it_was_lately() -> None:
    robot = RobotSound(HOP, BINS)
    for power in (*(100.0 * sound(60.0)), *sound(120.0)):
        robot.learn(power)
    assert [said for power in sound(4.5) if (said := robot.compare(power, NOTHING)) is not None] == [True]
