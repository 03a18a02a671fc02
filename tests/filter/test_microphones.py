"""Which microphones of an array are left out, told of seconds of sound without a filter."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.filter.microphones import Microphones

HOP, HOPS = 256, 62
"""Of a second."""
SECOND = HOP * HOPS
NOTHING = np.zeros(SECOND, np.float32)


def noise(seed: int, level: float = 0.1) -> np.ndarray:
    return (level * np.random.default_rng(seed).standard_normal(SECOND)).astype(np.float32)


def listen(watched: Microphones, mics, errors=None, ref=NOTHING, located=True) -> dict[int, str]:
    """Who is left out after a second of mics (count, n), of which errors are left; located: in each hop, or in all."""
    mics = np.asarray(mics, np.float32)
    errors = mics if errors is None else np.asarray(errors, np.float32)
    there = np.broadcast_to(located, HOPS)
    for at in range(HOPS):
        here = slice(at * HOP, (at + 1) * HOP)
        watched.step(mics[:, here], errors[:, here], ref[here], ref[here], bool(there[at]))
    return dict(watched.left_out)


def alike(count: int = 3) -> np.ndarray:
    """Microphones of an array: the same sound, and a little of each one's own."""
    return np.stack([noise(0) + noise(1 + at, 0.03) for at in range(count)])


def test_equal_microphones_are_all_used_from_the_first_second_on() -> None:
    watched = Microphones(3, HOP)
    assert watched.used.all() and listen(watched, alike()) == {} and watched.used.all()


def test_a_microphone_that_is_sound_again_is_used_again_after_three_seconds() -> None:
    watched, sound, broken = Microphones(3, HOP), alike(), alike()
    broken[1] = 0.0
    assert [listen(watched, heard) for heard in (broken, sound, sound, sound)] == [{1: "silent"}] * 3 + [{}]
    # a loose contact
    assert [list(listen(watched, heard)) for heard in (broken, sound, broken, sound, sound)] == [[1]] * 5


@pytest.mark.parametrize(("level_db", "often", "out"), [(-0.05, 16, {1: "clipped"}), (-0.05, 15, {}), (-0.15, 62, {})])
def test_a_microphone_is_clipped_where_16_samples_of_a_second_reach_full_scale_nearly(level_db, often, out) -> None:
    mics = alike()
    mics[1, 7 : often * HOP : HOP] = -(10 ** (level_db / 20))
    assert listen(Microphones(3, HOP), mics) == out


@pytest.mark.parametrize("level", [1.0, 1e-5])
def test_a_microphone_is_silent_beside_others_and_not_by_itself(level: float) -> None:
    mics = alike() * np.array([[1.0], [3e-4], [1.0]])
    assert listen(Microphones(3, HOP), level * mics) == {1: "silent"}
    assert "softer" in listen(Microphones(3, HOP), level * alike() * np.array([[1.0], [3e-3], [1.0]]))[1]


def test_of_two_microphones_the_softer_one_is_of_another_gain() -> None:
    assert listen(Microphones(2, HOP), alike(2) * np.array([[0.05], [1.0]])) == {0: "26 dB softer than the others"}


def test_where_all_are_clipped_none_is_left_out_for_it() -> None:
    clipped = np.clip(20.0 * alike(), -1.0, 1.0)
    assert listen(Microphones(3, HOP), clipped) == {}
    clipped[0] *= 0.9
    assert listen(Microphones(3, HOP), clipped) == {1: "clipped", 2: "clipped"}


def test_a_copy_of_a_channel_is_left_out_and_one_that_is_nearly_alike_is_not() -> None:
    mics = alike()
    mics[2] = mics[0] + 1e-5 * mics[1]
    assert listen(Microphones(3, HOP), mics) == {2: "the same as channel 0"}
    mics[2] = mics[0] + 0.1 * mics[1]
    assert listen(Microphones(3, HOP), mics) == {}


@pytest.mark.parametrize(
    ("left", "out"),
    [
        ((0.02, 0.02, 0.9), [2]),  # the robot is taken off in two of them
        ((0.02, 0.02, 0.25), []),  # more than ten times as much is left, and little all the same
        ((0.08, 0.08, 0.5), []),  # more than a little, and not ten times as much
        ((0.4, 0.4, 0.9), []),  # taken off in none: it may be a human whom all hear
        ((0.02, 0.02, 0.02), []),
    ],
)
def test_a_microphone_in_which_the_robot_stays_is_left_out_where_it_goes_in_the_others(left, out) -> None:
    mics = alike()
    errors = mics * np.sqrt(left)[:, None]
    assert sorted(listen(Microphones(3, HOP), mics, errors)) == out


def test_what_is_played_is_no_microphone_and_is_asked_for_where_one_is_doubted_alone() -> None:
    played = noise(9, 0.5)
    mics = np.stack([*alike(2), played])
    assert listen(Microphones(3, HOP), mics, ref=played) == {2: "what is played, not a microphone"}
    # as loud as the others, it is no other than they
    assert listen(Microphones(3, HOP), np.stack([*alike(2), 0.2 * played]), ref=played) == {}
    assert len(listen(Microphones(2, HOP), np.stack([played, 30.0 * played]), ref=played)) == 1  # one has to be heard


def test_where_all_would_be_left_out_all_are_used() -> None:
    watched = Microphones(3, HOP)
    assert listen(watched, np.zeros((3, SECOND))) == {}
    assert watched.first == 0 and watched.used.all()


def paths() -> np.ndarray:
    rng = np.random.default_rng(3)
    return (rng.standard_normal((3, 600)) * np.exp(-np.arange(600) / 80)).astype(np.float32)


@pytest.mark.parametrize("located", [True, np.arange(HOPS) != 10])
def test_exchanged_channels_are_told_of_a_second_in_which_the_robot_was_found_throughout(located) -> None:
    ref = noise(5)
    heard = np.stack([np.convolve(ref, path)[:SECOND] for path in paths()])[[1, 0, 2]]
    found = listen(Microphones(3, HOP, paths()), heard, 0.01 * heard, ref, located)
    told = {0: 1, 1: 0} if np.all(located) else {}
    assert found == {at: f"exchanged: it hears the robot as channel {o} was calibrated to" for at, o in told.items()}


def test_what_was_found_of_an_exchange_is_not_asked_again() -> None:
    ref, watched = noise(5), Microphones(3, HOP, paths())
    heard = np.stack([np.convolve(ref, path)[:SECOND] for path in paths()])
    first = listen(watched, heard[[1, 0, 2]], 0.01 * heard, ref)
    assert sorted(first) == [0, 1]
    assert [listen(watched, heard, 0.01 * heard, ref) for _ in range(4)] == [first] * 4


def test_where_every_channel_is_exchanged_one_of_them_is_used() -> None:
    ref = noise(5)
    heard = np.stack([np.convolve(ref, path)[:SECOND] for path in paths()])[[1, 2, 0]]
    watched = Microphones(3, HOP, paths())
    listen(watched, heard, 0.01 * heard, ref)
    assert watched.used.tolist() == [True, False, False]
