"""How much of the robot is removed is told by what the filter does now, and not by a human or by its first seconds."""

import numpy as np
import pytest

from edgefilter.filter.canceller import CancellerOutput
from edgefilter.filter.removal import Removal

HOP = 256


def robot(seconds: float, seed: int = 0) -> np.ndarray:
    """Hops (n, HOP) of noise in syllables of 0.2 s with pauses of 0.1 s."""
    rng = np.random.default_rng(seed)
    hops = round(seconds * 16000 / HOP)
    loud = np.repeat(rng.uniform(0.3, 1.0, hops), HOP) * ((np.arange(hops * HOP) % 4800) < 3200)
    return (0.05 * loud * rng.standard_normal(hops * HOP)).astype(np.float32).reshape(hops, HOP)


def watched(
    mic: np.ndarray, left: np.ndarray, misaligned: np.ndarray | float = 0.01, played: np.ndarray | None = None
) -> Removal:
    """What was seen of a microphone (n, HOP) of which left (n, HOP) is left; misaligned: share of it that is yet to be learned, in each hop.

    played: the reference (n, HOP), None for the microphone.
    """
    removal = Removal(HOP)
    shares = np.broadcast_to(misaligned, len(mic))
    for heard, error, reference, share in zip(mic, left, mic if played is None else played, shares, strict=True):
        power = np.full(HOP + 1, share * float(error.dot(error)), np.float32)
        removal.step(heard, reference, CancellerOutput(heard - error, error, power, error))
    return removal


def test_nothing_is_told_before_three_seconds_of_robot():
    echo = robot(8.0)
    assert watched(echo[:180], echo[:180]).removed_db is None
    assert watched(echo, 0.1 * echo).removed_db == pytest.approx(20.0, abs=0.01)


def test_the_first_seconds_of_a_filter_that_learns_are_forgotten():
    """A sum from the first hop on said for many seconds that the robot was made louder by up to 77 dB."""
    echo = robot(16.0)
    size = np.full((len(echo), 1), 0.03, np.float32)
    size[:20] = 7000.0
    assert watched(echo, size * echo).removed_db == pytest.approx(30.5, abs=0.1)


def test_a_human_who_talks_for_less_than_half_of_the_time_does_not_lower_what_is_removed():
    echo, human = robot(12.0), robot(12.0, seed=3)
    human[np.arange(len(echo)) // 100 % 3 > 0] = 0.0
    assert watched(echo + human, 0.03 * echo + human).removed_db > 25.0


@pytest.mark.parametrize(
    ("left", "misaligned", "said"),
    [(0.9, 0.01, True), (0.9, 0.15, True), (0.9, 0.6, False), (0.9, 1.0, False), (0.6, 0.01, False)],
    ids=["hardly anything removed", "as good as learned", "half learned", "still learning", "4 dB removed"],
)
def test_an_echo_counts_as_unpredicted_once_the_filter_has_learned_what_it_can(left, misaligned, said):
    echo = robot(12.0)
    assert watched(echo, np.float32(left) * echo, misaligned).unpredicted == said


def test_somebody_who_talks_all_the_time_does_not_make_the_echo_unpredicted():
    echo, human = robot(12.0), 3.0 * robot(12.0, seed=3)[::-1]
    removal = watched(echo + human, 0.1 * echo + human, played=echo)
    assert removal.removed_db < 3.0 and not removal.unpredicted


def test_a_filter_that_has_learned_in_a_quarter_of_the_time_is_still_learning():
    echo = robot(16.0)
    shares = np.where(np.arange(len(echo)) // 64 % 4 == 0, 0.01, 1.0)
    assert not watched(echo, np.float32(0.9) * echo, shares).unpredicted


@pytest.mark.parametrize(("once_db", "said"), [(4.5, True), (8.0, False)])
def test_an_echo_of_which_enough_was_removed_once_is_linear_so_that_less_later_has_another_cause(once_db, said):
    echo = robot(24.0)
    left = np.where(np.arange(len(echo)) < len(echo) // 2, 10 ** (-once_db / 20), 0.9).astype(np.float32)[:, None]
    assert watched(echo, left * echo).unpredicted == said


def test_somebody_who_talks_in_the_robot_s_pauses_does_not_lower_what_is_removed():
    """The reference of a loopback is not quite silent there."""
    echo, human = robot(12.0), 0.05 * np.random.default_rng(1).standard_normal((750, HOP)).astype(np.float32)
    pause = (np.arange(len(echo)) % 19 > 12)[:, None]
    echo = np.where(pause, np.float32(0.003), 1.0) * np.random.default_rng(2).standard_normal(echo.shape) * 0.05
    echo, human = echo.astype(np.float32), human * pause
    assert watched(echo + human, 0.03 * echo + human, played=echo).removed_db > 25.0


def test_words_that_are_softer_than_the_loudest_tell_as_much():
    echo = np.random.default_rng(0).standard_normal((300, HOP)).astype(np.float32)
    echo[20:] *= 10 ** (-14 / 20)
    assert watched(echo, 0.1 * echo).removed_db == pytest.approx(20.0, abs=0.01)


def test_a_robot_that_is_turned_down_is_told_of_again_once_its_loud_words_are_long_past():
    echo = np.random.default_rng(0).standard_normal((2500, HOP)).astype(np.float32)
    left = np.full((len(echo), 1), 0.03, np.float32)
    echo[500:] *= 10 ** (-30 / 20)
    left[500:] = 0.3
    assert watched(echo, left * echo).removed_db == pytest.approx(10.5, abs=0.1)
