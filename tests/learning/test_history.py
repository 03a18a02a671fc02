"""What is kept of the hops, how long, and which of it says something of the path."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from edgefilter.filter.echo_path import TAPS, FilteredHop
from edgefilter.learning.history import HopHistory, emphasised

HOP = 4000
"""A quarter of a second: a minute is 240 hops, the newest 15 s are 60."""


def hop(
    number: int, located: bool = True, idle: bool = False, switched: bool = False, delay: float = 0.0
) -> FilteredHop:
    """One whose microphone holds its number, its reference twice that and its innovation three times."""
    mic = np.full(HOP, number, np.float32)
    return FilteredHop(mic, 2 * mic, 3 * mic, located, idle, 4 * mic if switched else None, delay)


def history(*hops: FilteredHop) -> HopHistory:
    kept = HopHistory(HOP)
    for number, one in enumerate(hops):
        kept.append(one, audible=number % 2 == 1)
    return kept


def numbers(kept: HopHistory) -> list[int]:
    """Of the hops that are kept."""
    return [int(number) for number in kept.signal("mic")[::HOP]]


def test_a_minute_at_least_is_kept_and_a_quarter_more_at_most() -> None:
    kept = HopHistory(HOP)
    for count in range(1, 363):
        kept.append(hop(count), audible=True)
        if held := {1: 1, 240: 240, 300: 300, 301: 240, 361: 300, 362: 240}.get(count):
            assert numbers(kept) == list(range(count + 1 - held, count + 1))
    assert kept.count == 362


def test_what_came_since_is_told_as_far_as_15_s_reach() -> None:
    kept = history(*(hop(number) for number in range(70)))
    assert [one.mic[0] for one, _ in kept.since(67)] == [67, 68, 69]
    assert [audible for _, audible in kept.since(67)] == [True, False, True]
    assert [one.mic[0] for one, _ in kept.since(0)] == list(range(10, 70))
    assert list(kept.since(70)) == []
    assert numbers(kept.recent()) == list(range(10, 70))


def test_a_part_of_it_is_there_before_15_s_have_come() -> None:
    kept = history(hop(0), hop(1))
    assert [one.mic[0] for one, _ in kept.since(0)] == [0, 1] and numbers(kept.recent()) == [0, 1]


def test_the_microphone_is_kept_as_it_was_whatever_the_caller_writes_there_later() -> None:
    one = hop(5)
    kept = history(one)
    one.mic[:] = 0.0
    assert numbers(kept) == [5]


def test_of_an_array_the_first_microphone_is_told() -> None:
    one = hop(1)
    pair = one._replace(mic=np.stack((one.mic, 7 * one.mic)), innovation=np.stack((one.innovation, one.mic)))
    for name, wanted in {"mic": 1.0, "reference": 2.0, "innovation": 3.0}.items():
        np.testing.assert_array_equal(history(pair, pair).signal(name), np.full(2 * HOP, wanted))


@pytest.mark.parametrize(
    ("located", "idle", "usable"),
    [(True, False, True), (True, True, False), (False, False, False), (False, True, False)],
)
def test_a_path_is_taught_where_the_robot_may_be_heard_at_a_delay_that_is_known(located, idle, usable) -> None:
    kept = history(hop(0, located, idle))
    assert kept.usable().tolist() == [usable] * HOP and kept.silent().tolist() == [idle] * HOP


def test_for_the_length_of_a_path_after_a_switch_of_the_delay_nothing_is_usable() -> None:
    kept = history(*(hop(number, switched=number in (2, 3)) for number in range(8)))
    lasts = TAPS[1] // HOP
    assert lasts == 2 and kept.usable()[::HOP].tolist() == 2 * [True] + 3 * [False] + 3 * [True]


@pytest.mark.parametrize(("silent", "told"), [(4, range(8)), (5, range(5))])
def test_the_noise_is_what_is_heard_in_silence_where_that_is_more_than_a_second(silent, told) -> None:
    kept = history(*(hop(number, idle=number < silent) for number in range(8)))
    assert kept.noise()[::HOP].tolist() == list(told)


@pytest.mark.parametrize(("delays", "latest"), [([1.0, 2.0, float("nan")], 2.0), ([float("nan")], 0.0), ([], 0.0)])
def test_the_delay_is_the_latest_that_is_known(delays, latest) -> None:
    assert history(*(hop(0, delay=delay) for delay in delays)).delay == latest


@dataclass
class Steps:
    """Stands for an echo path: what it was stepped with."""

    seen: list[tuple] = field(default_factory=list)

    def step(self, *given) -> None:
        self.seen.append(given)


def test_a_path_is_stepped_through_all_of_it_as_the_filter_was() -> None:
    path, hops = Steps(), [hop(0), hop(1, located=False), hop(2, switched=True)]
    history(*hops).replay(path)
    for (mic, reference, located, past), one in zip(path.seen, hops, strict=True):
        np.testing.assert_array_equal(mic, one.mic)
        assert (reference is one.reference, located, past is one.past) == (True, one.located, True)


def test_hops_longer_than_a_minute_are_kept_one_at_a_time() -> None:
    kept = HopHistory(16_000 * 200)
    for number in range(3):
        kept.append(FilteredHop(*(np.full(1, number, np.float32),) * 3, True, False, None, 0.0), audible=True)
    assert kept.signal("mic").tolist() == [2.0]


def test_the_power_with_pre_emphasis_is_that_of_all_microphones() -> None:
    x = np.random.default_rng(0).standard_normal((2, 100)).astype(np.float32)
    assert emphasised(x) == pytest.approx(emphasised(x[0]) + emphasised(x[1]), rel=1e-6)  # float32
