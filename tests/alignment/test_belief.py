"""The lag of a whole recording: what is found, how certainly, and that nothing is found where there is nothing."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.alignment.belief import believe, believed, find_lag
from edgefilter.alignment.lag_search import Found
from edgefilter.dsp.fractional_delay import interpolate
from edgefilter.errors import SignalError
from tests.diagnosis.robot_scene import DELAY, record, voice

RATE = 16000


@pytest.fixture(scope="module")
def said():
    return voice(8.0)


@pytest.fixture(scope="module")
def heard(said):
    return record(said)


@pytest.mark.parametrize("lag", [-40_000, -3000, 0, 5000, 44_000])
def test_any_lag_either_way_is_found_beside_a_talker_as_loud(said, heard, lag):
    mixed = heard + voice(8.0, seed=5) * np.sqrt(np.mean(heard**2) / np.mean(voice(8.0, seed=5) ** 2))
    shifted = np.roll(np.pad(mixed, (48_000, 48_000)), lag)
    assert find_lag(shifted, np.pad(said, (48_000, 48_000))) == pytest.approx(DELAY + lag, abs=2)


@pytest.mark.parametrize("lag", [-3000, 0, round(DELAY) - 16])
def test_swapped_files_are_known_by_the_reverberation_before_its_sound(said, heard, lag):
    later = np.roll(np.pad(said, (0, RATE)), lag)
    with pytest.raises(SignalError, match="seem to be swapped"):
        find_lag(later, np.pad(heard, (0, RATE)))


def test_of_other_sounds_nothing_is_certain_and_it_is_said_which_error_is_likely(said):
    for other in (voice(8.0, seed=9), 0.1 * np.random.default_rng(7).standard_normal(said.size).astype(np.float32)):
        assert believe(other, said).certain.size == 0
    with pytest.raises(SignalError, match=r"of another recording, or was the loudspeaker muted"):
        find_lag(voice(8.0, seed=9), said)


def test_each_second_has_the_lag_that_holds_there(said, heard):
    middle, moved = said.size // 2, 900
    found = believe(np.concatenate((heard[:middle], heard[middle - moved : -moved])), said)
    assert found.lags == pytest.approx([DELAY] * 4 + [DELAY + moved] * 4, abs=2)
    assert found.certain.size == 8


def test_clocks_that_drift_move_the_lag(said):
    slow = record(interpolate(said, np.arange(said.size) * (1 - 600e-6)))
    lags = believe(slow, said).certain
    middles = DELAY + 600e-6 * RATE * (np.arange(8) + 0.5)
    assert lags == pytest.approx(middles, abs=8)  # what is loud in a second is anywhere in it


def test_a_second_in_which_the_robot_is_silent_keeps_the_lag(said):
    paused = said.copy()
    paused[3 * RATE : 5 * RATE] = 0.0
    found = believe(record(paused), paused)
    assert found.lags == pytest.approx([DELAY] * 8, abs=2) and found.certain.size == 8


@pytest.mark.parametrize("seconds", [0.0, 0.01, 0.3])
def test_too_little_or_silence_is_no_lag(said, seconds):
    count = round(seconds * RATE)
    assert believe(np.zeros(count, np.float32), said).lag is None
    assert believe(said[:count], np.zeros(RATE, np.float32)).lag is None


def test_one_word_in_common_makes_two_recordings_no_pair():
    said, other, word = voice(24.0), record(voice(24.0, seed=9)), slice(8 * RATE, 9 * RATE)
    other[word] += 0.3 * record(said)[word]
    assert believe(other[word], said[word]).certain.size == 1
    assert believe(other, said).lag is None


def looks(*lags, clearness=1.4):
    """What looks that found these lags say together."""
    return believed([Found(lag, clearness, RATE * second) for second, lag in enumerate(lags, 1)])


def test_weak_looks_that_agree_are_certain_and_ten_milliseconds_are_waited_for():
    assert looks(-2088).late[-1] < 0.5 < 0.99 < looks(-2088, 5000, -2098, -2111).late[-1]
    assert 0.5 < looks(-2088, 5000, -2098, -7111).late[-1] < 0.99
    assert looks(-60, -60, clearness=2.4).late[-1] < 0.01


def test_a_lag_that_grows_again_and_again_is_lost_samples_and_one_that_moves_otherwise_is_not():
    assert looks(*range(800, 1440, 160), clearness=2.4).lost == 480
    assert looks(*range(1440, 800, -160), clearness=2.4).lost == 0
    assert looks(*range(800, 1000, 5), clearness=2.4).lost == 0  # clocks
    for lags in np.random.default_rng(0).integers(800, 22_000, (20, 12)).tolist():  # each utterance has its own
        assert looks(*lags, clearness=2.4).lost == 0


@pytest.mark.parametrize("seed", range(20))
def test_a_lag_that_wanders_to_and_fro_among_arrivals_alike_is_no_lost_samples(seed):
    """A path that rings at 680 Hz: its correlation has a peak each 23 samples, all but equal."""
    arrivals = 2180 + 23 * np.random.default_rng(seed).integers(0, 6, 12)
    assert looks(*arrivals, clearness=2.4).lost == 0
    assert looks(*arrivals[:4], *(arrivals[3] + 640 * np.arange(1, 8)), clearness=2.4).lost > 3000
