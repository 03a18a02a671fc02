"""What is believed after a look at the delay: that it drifts, that it has jumped, or nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edgefilter.alignment.delay_line import DelayBuffer
from edgefilter.alignment.delay_tracker import FRAME, STRIDE, DelayMeasurement, DelayMeter, DriftFilter


def look(
    offset: float,
    strength: float = 10.0,
    ratio: float = 2.0,
    gain: float = 1.0,
    gain_there: float = 1.0,
    explained: float = 1.0,
) -> DelayMeasurement:
    """One that is sure of its offset."""
    return DelayMeasurement(offset, 1e-6, strength, ratio, explained, gain, gain_there)


def seen(found: DelayMeasurement, deviation: float = 0.1, far: bool = False) -> str:
    """Where a look sees the robot whose delay is known to that deviation and that has brought a power of 1."""
    drift = DriftFilter()
    drift.restart(1000.0, deviation)
    return drift.where_seen(found, 1.0, far)


# the delay half a frame ago is less sure by what the clocks may differ: 0.15 samples
@pytest.mark.parametrize(
    ("deviation", "drift", "jump"),
    [
        (0.05, 0.75, 0.85),  # 5 standard deviations
        (0.7, 3.6, 3.8),  # 3 of them, and of a sample that a weak look may be wrong by
        (0.4, 1.45, 1.55),  # 1.5 samples, beyond 3 of them
        (3.0, 7.9, 8.1),  # 8 samples
    ],
)
def test_an_error_is_put_down_to_the_drift_where_it_is_small_or_to_be_expected(deviation, drift, jump):
    assert seen(look(drift), deviation) == seen(look(-drift), deviation) == "there"
    assert seen(look(jump), deviation) == seen(look(-jump), deviation) == "elsewhere"


@pytest.mark.parametrize(("explained", "deviation"), [(0.0, 0.1), (0.75, 0.05), (1.0, 0.0)])
def test_a_look_may_err_by_a_tenth_of_a_sample_where_it_explains_nothing(explained, deviation):
    """As looks close to one another do together, so that their number says nothing."""
    drift = DriftFilter()
    drift.restart(1000.0, 0.05)
    expected = np.hypot(0.05, 0.1536)  # the delay's, and 150 ppm of half a frame
    wanted = 0.3 / np.hypot(expected, deviation)
    assert drift.surprise(look(0.3, explained=explained)) == pytest.approx(wanted, rel=1e-3)


@pytest.mark.parametrize(
    ("found", "what"),
    [
        (look(100.0, strength=5.9), "unseen"),
        (look(0.0, strength=5.9), "unseen"),
        (look(100.0, strength=6.1), "elsewhere"),
        (look(100.0, gain=9.9), "elsewhere"),
        (look(100.0, gain=10.1), "drowned"),
        (look(0.0, gain=10.1), "there"),
        (look(100.0, gain_there=0.26), "elsewhere"),
        (look(100.0, gain_there=0.24), "unseen"),
        (look(100.0, gain_there=10.1), "unseen"),
        (look(959.0), "elsewhere"),
        (look(-961.0), "unseen"),
        (look(100.0, ratio=9.0), "elsewhere"),
    ],
)
def test_a_look_counts_where_its_peak_stands_out_and_the_robot_is_as_loud_as_it_was(found, what):
    assert seen(found) == what


def test_two_looks_that_see_the_robot_elsewhere_see_a_jump():
    drift = DriftFilter()
    drift.restart(1000.0, 0.05)
    assert [drift.where_seen(look(100.0, ratio=1.6), 1.0, False) for _ in range(2)] == ["elsewhere", "jumped"]


def test_a_far_look_sees_three_times_as_far():
    assert seen(look(3007.0), far=True) == "elsewhere" and seen(look(3009.0), far=True) == "unseen"


@pytest.mark.parametrize(("offset", "enough"), [(8.0, 20.0), (8.1, 30.0), (1024.0, 30.0), (-1025.0, 55.7)])
def test_a_jump_is_believed_from_so_much_evidence_on_as_chance_has_places(offset, enough):
    for share, believed in ((0.99, False), (1.01, True)):
        witness, half = DriftFilter(), look(offset, 1.0, 0.5 * share * enough)
        assert [witness.convinced(half) for _ in range(2)] == [False, believed]


@pytest.mark.parametrize(("further", "believed"), [(1.49, True), (1.51, False), (-1.49, True)])
def test_the_evidence_of_looks_at_the_same_jump_is_added(further, believed):
    witness = DriftFilter()
    assert not witness.convinced(look(100.0, 1.0, 0.6 * 30.0))
    assert witness.convinced(look(100.0 + further, 1.0, 0.6 * 30.0)) is believed


@pytest.mark.parametrize("other", [0.1, 0.6])
def test_a_suspicion_is_replaced_by_another(other):
    witness = DriftFilter()
    witness.convinced(look(100.0, 1.0, 0.9 * 30.0))
    assert not witness.convinced(look(-50.0, 1.0, other * 30.0))
    assert not witness.convinced(look(100.0, 1.0, 0.9 * 30.0))
    assert witness.convinced(look(100.0, 1.0, 0.9 * 30.0))


def test_delay_and_drift_are_those_of_a_kalman_filter_with_a_look_at_the_middle_of_its_frame():
    """The textbook's, in matrices: the delay at the frame's end moves by the slope, and a look sees it half a frame earlier."""
    rng, drift = np.random.default_rng(0), DriftFilter()
    drift.restart(1000.0, 1.0)
    state, belief = np.array([1000.0, 0.0]), np.diag([1.0, 150e-6**2])
    for variance, hop in zip(rng.uniform(0.01, 1.0, 40), rng.integers(100, 3000, 40), strict=True):
        moved = np.array([[1.0, hop], [0.0, 1.0]])
        state, belief = moved @ state, moved @ belief @ moved.T + hop / STRIDE * np.diag([1e-6, 0.15e-6**2])
        drift.advance(int(hop))
        seen = np.array([1.0, -FRAME / 2])
        offset = 1.5 * rng.standard_normal() * np.sqrt(seen @ belief @ seen + variance)
        drift.correct(replace(look(offset, strength=20.0), variance=variance))
        gain = belief @ seen / (seen @ belief @ seen + variance)
        state, belief = state + gain * offset, belief - np.outer(gain, seen @ belief)
        assert drift.delay == pytest.approx(state[0], abs=1e-6) and drift.slope == pytest.approx(state[1], abs=1e-9)
        assert drift.deviation == pytest.approx(np.sqrt(belief[0, 0]), rel=1e-6)


@pytest.mark.parametrize(("offset", "ppm"), [(3.0, 750.0), (-3.0, -750.0)])
def test_no_clock_is_believed_to_drift_by_more_than_750_ppm(offset, ppm):
    drift = DriftFilter()
    drift.restart(1000.0, 1.0)
    for _ in range(20):
        drift.advance(STRIDE)
        drift.correct(look(offset, strength=20.0))
    assert drift.slope == pytest.approx(1e-6 * ppm)


def steady() -> DriftFilter:
    """After a minute of looks at a delay that holds, so that the clocks are known to agree."""
    drift = DriftFilter()
    drift.restart(1000.0, 1.0)
    for _ in range(1000):
        drift.advance(STRIDE)
        drift.correct(look(0.0, strength=20.0))
    return drift


@pytest.mark.parametrize(
    ("make", "deviation", "offset", "variance", "share"),
    [
        (steady, 1.5, 3.0, 4.0, 2.25 / 6.25),  # no contradiction
        (steady, 1.5, 30.0, 4.0, 4.0 / 8.0),  # up to the uncertainty of the start, 2 samples
        (steady, 0.1, 1.0, 0.01, 0.99),  # until the offset is one standard deviation
        (DriftFilter, 1.5, 30.0, 4.0, 2.27 / 6.27),  # the clocks are as unsure as at the start, and so half a frame
    ],
)
def test_belief_is_widened_where_a_look_contradicts_it_but_not_beyond_that_of_the_start(
    make, deviation, offset, variance, share
):
    drift = make()
    drift.restart(1000.0, deviation)
    drift.correct(replace(look(offset, strength=20.0), variance=variance))
    assert drift.delay - 1000.0 == pytest.approx(share * offset, rel=1e-2)


@pytest.mark.parametrize(
    ("after", "offset", "wrong_ppm"),
    [
        (10, 0.5, 0.5 / 10 / STRIDE * 1e6),
        (10, -0.5, 0.5 / 10 / STRIDE * 1e6),
        (0, 0.1, 0.1 / STRIDE * 1e6),  # a look comes each STRIDE samples at least
        (10, 2.0, 150.0),  # no less sure than at the start
        (10, 9.0, 0.0),  # buffers
        (0, 2.0, 0.0),  # beyond what clocks differ by
    ],
)
def test_a_small_jump_may_come_from_a_wrong_slope_since_the_last_look(after, offset, wrong_ppm):
    drift = steady()
    drift.advance(after * STRIDE)
    drift.step(replace(look(offset), variance=0.09))
    drift.advance(16 * STRIDE)
    assert drift.delay == pytest.approx(1000.0 + offset, abs=0.01)
    assert drift.deviation == pytest.approx(np.hypot(0.3, 16 * STRIDE * 1e-6 * wrong_ppm), rel=0.02)


@pytest.mark.parametrize("level", [1.0, 1e-3])
@pytest.mark.parametrize(("far", "error"), [(False, 0.0), (False, 60.0), (False, -60.0), (True, 900.0), (True, -900.0)])
def test_a_look_finds_how_far_the_delay_is_off_and_stands_out_there(far, error, level) -> None:
    """Of noise and its echo, as late by 500 samples and the error."""
    rng = np.random.default_rng(3)
    sound = (0.1 * level * rng.standard_normal(32_000)).astype(np.float32)
    mic, ref = DelayBuffer(32_000), DelayBuffer(32_000)
    ref.push(sound)
    mic.push(np.roll(sound, 500 + round(error)))
    found = DelayMeter().measure(mic, ref, 30_000, 500.0, 0.0, far)
    assert found is not None and found.offset == pytest.approx(error, abs=0.05)
    assert found.strength > 20.0 and found.ratio > 2.0


@pytest.mark.parametrize("seed", range(4))
def test_an_arrival_that_is_spread_out_is_seen_at_its_delay_once_the_sound_that_showed_it_is_studied(seed):
    rng = np.random.default_rng(seed)
    spread = np.hanning(240) * rng.standard_normal(240)
    voice = rng.standard_normal(40 * STRIDE).astype(np.float32)
    heard = np.convolve(voice, np.concatenate((np.zeros(900), spread)))[: voice.size].astype(np.float32)
    mic, ref = DelayBuffer(voice.size), DelayBuffer(voice.size)
    mic.push(heard)
    ref.push(voice)
    meter, now = DelayMeter(), 20 * STRIDE
    before = meter.measure(mic, ref, now + FRAME, 1000.0, 0.0, far=False)
    meter = DelayMeter()
    meter.study(mic, ref, now - 7 * STRIDE, now, 1000.0, 0.0)
    after = meter.measure(mic, ref, now + FRAME, 1000.0, 0.0, far=False)
    assert abs(before.offset) > 8.0 or before.strength < 10.0
    assert abs(after.offset) < 1.0
    assert after.strength > 1.5 * before.strength
