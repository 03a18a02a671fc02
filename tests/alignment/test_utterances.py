"""Where utterances begin in the reference, how long announced ones are waited for, and which sounds can only be the robot."""

import numpy as np
import pytest

from edgefilter.alignment.utterances import Announcements, FirstSounds, OnsetDetector
from edgefilter.types import SAMPLE_RATE

HOP = 256
LAST_BIT = 2.0**-23


@pytest.mark.parametrize("amplitude, begins", [(0.9 * LAST_BIT, False), (1.1 * LAST_BIT, True)])
def test_a_reference_below_a_converters_last_bit_is_silent(amplitude, begins):
    detector = OnsetDetector(HOP)
    assert detector.step(np.zeros(HOP, np.float32)) is None
    found = detector.step(np.full(HOP, amplitude, np.float32))
    assert (found is not None) is detector.active is begins


@pytest.mark.parametrize(("silent", "begins"), [(19, False), (20, True)])
def test_an_utterance_begins_after_a_fifth_of_a_second_of_silence(silent, begins):
    detector, hop = OnsetDetector(160), np.full(160, 0.1, np.float32)
    assert detector.step(hop) is detector.current
    for _ in range(silent):
        detector.step(0 * hop)
    found = detector.step(hop)
    assert (found is not None) is begins
    if found:
        assert (found.start, found.end, found.after) == ((silent + 2 - 2) * 160, (silent + 2) * 160, 160)


@pytest.mark.parametrize(("softest", "varies"), [(10 ** (-14.9 / 20), False), (10 ** (-15.1 / 20), True)])
def test_a_reference_varies_as_a_voice_where_its_hops_differ_by_15_db(softest, varies):
    detector = OnsetDetector(HOP)
    for level in (softest, 1.0, 1.0, 1.0):
        detector.step(np.full(HOP, level, np.float32))
    assert detector.varies is varies


def test_a_click_of_two_hops_makes_no_voice_loud():
    detector = OnsetDetector(HOP)
    for level, peak in ((1.0, 0.0), (1.0, 0.0), (0.5, 0.25)):
        detector.step(np.full(HOP, level, np.float32))
        assert detector.peak == peak
    for _ in range(10 * SAMPLE_RATE // HOP):
        detector.step(np.zeros(HOP, np.float32))
    assert detector.peak == pytest.approx(0.025, rel=1e-3)  # 10 dB in ten seconds


def test_an_announced_utterance_is_waited_for_half_a_minute_and_then_the_next_one():
    announced, voice = Announcements(), np.ones(800, np.float32)
    for level in (1.0, 0.5):
        announced.add(level * voice)
    first = announced.expected(0)
    assert first is not None and first.start == -SAMPLE_RATE  # as if it had begun a second ago
    for now, level in ((30 * SAMPLE_RATE, 1.0), (30 * SAMPLE_RATE + 1, 0.5), (60 * SAMPLE_RATE + 1, 0.5)):
        expected = announced.expected(now)
        assert expected is not None and expected.utterance[0] == np.float32(level)
    assert announced.expected(60 * SAMPLE_RATE + 2) is None


def test_an_announced_utterance_begins_256_samples_before_its_first_sound_and_is_read_ahead_of_the_microphone():
    announced, voice = Announcements(), np.zeros(3000, np.float32)
    voice[500], voice[1000:2000], voice[2500] = 0.009, 1.0, 0.009  # what is 41 dB softer is no sound of it
    announced.add(voice)
    announced.add(0 * voice)
    playback = announced.begin(10_000)
    np.testing.assert_array_equal(playback.utterance, voice[1000 - 256 : 2000])
    assert playback.start == 10_000 - 4096 and announced.expected(20_000) is None


def first_sounds(power, explained=0.0, loudest=0.0, state="begun", waits=True, first=None):
    """Whether a hop of that power, mean square, can only be the robot, whose path is calibrated to lose nothing."""
    first, hop = first or FirstSounds(1000, np.ones(1)), np.ones(1000, np.float32)
    return first.step(power**0.5 * hop, explained**0.5 * hop, loudest, state, waits)


@pytest.mark.parametrize(
    ("loudest", "explained", "least"),
    [(1.0, 0.0, 0.05), (0.0, 0.0, 0.05 * 0.01), (1.0, 0.01, 1.0), (1.0, 0.0001, 0.05)],
)
def test_a_robot_whose_lag_is_unknown_is_told_by_its_level_13_db_below_its_loudest(loudest, explained, least):
    """At first a voice is taken to reach -20 dB; at a delay that explains some of it, 20 dB more than that."""
    assert first_sounds(1.005 * least, explained, loudest) and not first_sounds(0.995 * least, explained, loudest)
    assert not first_sounds(1.01 * least, explained, loudest, waits=False)


def test_once_the_robot_was_heard_its_level_is_known_and_believed_for_a_quarter_of_a_second():
    first = FirstSounds(1000, np.ones(1))
    for _ in range(2):  # 6 dB more than calibrated: a tenth of 3 dB is believed at once
        assert not first_sounds(4.0, 1.0, 1.0, "locked", False, first)
    least = 0.05 * 1.1**2
    assert not first_sounds(0.99 * least, 0.0, 1.0, first=first)
    assert [first_sounds(1.01 * least, 0.0, 1.0, first=first) for _ in range(6)] == [True] * 4 + [False] * 2
