"""The robot is known again by the shape of its spectrum, without a reference, and nobody else is taken for it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgefilter.filter.robot_sound import ALIKE_DB, HEARD_S, RobotSound

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


def shape(rng: np.random.Generator, spread_db: float) -> np.ndarray:
    """Power (BINS,) whose level has this standard deviation, dB, and wanders no faster over frequency than a band is wide."""
    knots = np.interp(np.linspace(0.0, 1.0, BINS), np.linspace(0.0, 1.0, 60) ** 2, rng.standard_normal(60))
    return 10.0 ** (spread_db * (knots - knots.mean()) / knots.std() / 10.0)


def test_the_robot_is_known_again_every_four_seconds_and_a_voice_of_another_colour_is_not() -> None:
    assert heard(sound(12.5)) == [True] * 3
    assert heard(sound(4.5, COLOUR * np.where(np.arange(BINS) % 40 < 20, 10.0, 0.1))) == [False]


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 999), level_db=st.floats(-15.0, 30.0))
def test_the_robot_is_known_at_any_level_and_a_sound_of_another_shape_at_none(seed: int, level_db: float) -> None:
    rng, gain = np.random.default_rng(seed), 10 ** (level_db / 10)
    assert heard(gain * sound(4.5, COLOUR * shape(rng, 0.7 * ALIKE_DB))) == [True]
    assert heard(gain * sound(4.5, COLOUR * shape(rng, 2.0 * ALIKE_DB))) == [False]


def test_one_sentence_of_an_unusual_colour_makes_nobody_else_of_a_robot_that_was_known() -> None:
    unusual = COLOUR * shape(np.random.default_rng(4), 1.5 * ALIKE_DB)
    assert heard(sound(4.5, unusual)) == [False]
    assert heard(np.concatenate([sound(8.5), sound(4.0, unusual)])) == [True] * 3
    assert heard(np.concatenate([sound(4.5), sound(60.0, unusual)]))[-1] is False


@pytest.mark.parametrize(("known_s", "said"), [(HEARD_S - 1.0, []), (HEARD_S + 1.0, [True])])
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
    # nor do they count for those that are heard
    fan = np.where(np.arange(BINS) > 40, 1.0, 1e-6).astype(np.float32)
    bent = sound(4.5, COLOUR * np.where(np.arange(BINS) % 20 < 10, 3.0, 1 / 3.0))
    assert heard(bent + fan, noise=fan) == [False]


def test_noise_alone_is_no_robot() -> None:
    assert not any(heard(sound(4.5), noise=1e3 * COLOUR))


def test_the_robot_is_as_it_was_lately() -> None:
    robot = RobotSound(HOP, BINS)
    other = COLOUR * shape(np.random.default_rng(3), 8.0)
    for power in (*sound(60.0, other), *sound(120.0)):
        robot.learn(power)
    assert [said for power in sound(4.5) if (said := robot.compare(power, NOTHING)) is not None] == [True]
