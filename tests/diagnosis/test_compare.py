"""Comparison of a recording with the profile's prediction: nothing left where nothing is missing, and the right place where something is."""

from __future__ import annotations

import json

import numpy as np
import pytest
import soxr

from edgefilter.calibration.from_recording import TAIL_S
from edgefilter.diagnosis.compare import describe
from edgefilter.diagnosis.prepare import find_talk, prepare
from edgefilter.diagnosis.recording import Recording, compare
from edgefilter.echo.model import EchoModel
from edgefilter.errors import SignalError
from edgefilter.report.html import comparison_page
from edgefilter.report.text import comparison_summary
from edgefilter.types import PRE_ROLL
from tests.diagnosis.robot_scene import DELAY, FAN, path, profile, record, voice


def test_nothing_is_left_of_the_robot_that_was_calibrated() -> None:
    x = voice(8.0)
    found = compare(profile(), record(x), x)
    assert (
        abs(found.excess_db) < 0.2
    )  # 8 s of fan are known to 0.05 dB; the whitening's finite length costs about as much
    assert abs(found.silence_excess_db) < 0.3
    assert found.human == ()


@pytest.mark.parametrize("lag", [-700.0, -12.5, 0.0, 0.25, 3200.0])
def test_a_constant_lag_is_found_either_way_and_leaves_nothing(lag: float) -> None:
    x = voice(8.0)
    found = compare(profile(), record(x, lag=lag), x)
    assert found.offset_samples == pytest.approx(lag, abs=0.02)  # 0.02 samples leave an error 36 dB below a 4 kHz tone
    assert found.excess_db < 0.5


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_a_reflection_as_loud_as_the_direct_sound_does_not_move_the_lag(seed: int) -> None:
    x, h = voice(8.0, seed=seed), path()
    h[PRE_ROLL + 103], h[PRE_ROLL + 136] = h[PRE_ROLL], 0.9 * h[PRE_ROLL]
    assert prepare(profile(), record(x, EchoModel(h)), x).offset == pytest.approx(0.0, abs=0.1)


def test_an_extra_band_of_noise_shows_in_its_band_and_in_the_silence() -> None:
    x = voice(8.0)
    recording = record(x)
    n = np.arange(recording.size) / 16000
    tones = sum(np.sin(2 * np.pi * f * n + f) for f in range(2100, 2900, 50))
    found = compare(profile(), recording + (2 * FAN * tones).astype(np.float32), x)
    bands = {low: excess for low, _, excess in found.bands}
    assert max(bands, key=bands.get) == 2000.0
    assert found.silence_excess_db == pytest.approx(found.excess_db, abs=1.0)  # the tones sound all the time


def test_utterances_with_lags_of_their_own_are_aligned_one_by_one() -> None:
    x = voice(12.0)
    x[5 * 16000 : 6 * 16000] = 0
    parts = (
        np.where(np.arange(x.size) < 5.5 * 16000, x, 0).astype(np.float32),
        np.where(np.arange(x.size) >= 5.5 * 16000, x, 0).astype(np.float32),
    )
    clean = [record(part, lag=lag, seed=seed) for part, lag, seed in zip(parts, (0.0, 4321.5), (3, 4), strict=True)]
    found = compare(
        profile(), clean[0] + clean[1] - FAN * np.random.default_rng(4).standard_normal(x.size).astype(np.float32), x
    )
    assert found.excess_db < 0.5
    assert any("different numbers of samples" in text and "4321.5 from" in text for text in found.warnings)


def test_clocks_that_drift_are_taken_out_and_said_but_not_for_a_diagnosis() -> None:
    """A jump or a path that changes, which a line through the lags imitates, is no drift."""
    x = voice(8.0)
    names = {"profile": "p", "recording": "m", "reference": "r"}
    for ppm, said in ((43.0, "43.0 ppm slower"), (-80.0, "80.0 ppm faster")):
        recording = Recording(record(x, profile().echo.with_effect("clock_drift", {"ppm": ppm})), x, profile())
        found, left = recording.compare(), describe(recording.straightened, recording.straightened.model)
        assert found.drift_ppm == pytest.approx(-ppm, abs=0.5)  # what the fit leaves of it
        assert found.excess_db < 2.0 < 20.0 < left.excess_db and left.drift_ppm == 0.0
        assert found.offset_samples == pytest.approx(0.0, abs=0.1)
        assert f"clocks      the microphone's runs {said}, compensated" in comparison_summary(found)
        assert f"<dt>Clocks</dt><dd><b>{said}</b>" in comparison_page(found, names)
    late = {"times_s": np.array([4.0]), "samples": np.array([20.0])}
    jumped = record(x, profile().echo.with_effect("delay_jump", late))
    after = np.clip((np.arange(x.size) - x.size // 2) / 9000, 0.0, 1.0).astype(np.float32)
    moved = (1.0 - after) * record(x) + after * record(x, lag=0.3)
    for recording in (jumped, moved):
        other = Recording(recording, x, profile()).compare()
        assert other.drift_ppm == 0.0 and other.excess_db > 5.0
        assert not any(line.startswith("clocks") for line in comparison_summary(other))


def test_somebody_talking_in_the_pauses_is_left_out_and_said() -> None:
    x = voice(16.0)
    x[5 * 16000 : int(6.5 * 16000)] = 0
    recording = record(x)
    talk = np.arange(int(5.4 * 16000), int(7.9 * 16000))
    recording[talk] += (12 * FAN * np.random.default_rng(6).standard_normal(talk.size)).astype(np.float32)
    found = compare(profile(), recording, x)
    ((begin, end),) = found.human
    assert begin < 5.7 and end > 6.5
    assert any("somebody talks" in text for text in found.warnings)


def test_a_reference_cut_in_the_middle_of_words_is_only_believed_in_between() -> None:
    x = voice(10.0)
    recording = record(x)
    begin, end = 5000, 8 * 16000 + 16000  # both inside a word: the pauses are the last half of every other second
    found = compare(profile(), recording[begin:], x[begin:end])
    assert found.excess_db < 0.5  # 10 dB and more where what was said before and after it counts
    assert found.times[0][1] > 0.3 and found.times[-1][0] < (end - begin) / 16000 + 0.5
    assert any("mid-word" in text for text in found.warnings)


def test_where_a_cut_reference_lags_by_two_numbers_its_beginning_counts_by_the_first_and_its_end_by_the_last() -> None:
    lags, cut = (1600.0, -2400.0), slice(18_000, 112_000)  # both inside a word
    whole = voice(9.0)
    whole[4 * 16_000 : 5 * 16_000] = 0.0
    early = np.arange(whole.size) < 4.5 * 16_000
    heard = sum(record(part, lag=lag) for part, lag in zip((whole * early, whole * ~early), lags, strict=True))
    x = whole[cut]
    prepared = prepare(profile(), heard[cut].astype(np.float32), x)
    first, last = (DELAY - PRE_ROLL + lag for lag in lags)
    known = np.flatnonzero(prepared.usable)[[0, -1]]
    assert known == pytest.approx([first + TAIL_S * 16000, x.size + last - 1], abs=1.0)  # of a fraction of a sample
    assert any("mid-word" in text for text in prepared.warnings)


def test_levels_are_those_at_which_the_voice_is_heard_over_the_fan() -> None:
    x = voice(8.0)
    found = compare(profile(), record(x), x)
    assert found.levels and all(high > found.noise_floor_db - 6.0 for _, high, _ in found.levels)


def test_another_rate_is_converted() -> None:
    x = voice(6.0)
    up = [soxr.resample(s, 16000, 48000) for s in (record(x), x)]
    assert (
        compare(profile(), *up, sample_rate=48000).excess_db < 0.5
    )  # the converters' roll-off near 8 kHz is all that differs


def test_the_dictionary_is_json_and_holds_no_signals() -> None:
    x = voice(4.0)
    found = json.loads(json.dumps(compare(profile(), record(x), x).to_dict(), allow_nan=False))
    assert {"excess_db", "bands", "times", "levels", "lags"} <= set(found) and "residual" not in found


def test_a_recording_of_something_else_is_refused() -> None:
    with pytest.raises(SignalError, match="does not contain the reference"):
        compare(profile(), FAN * np.random.default_rng(8).standard_normal(64000).astype(np.float32), voice(4.0))


def test_a_microphone_gain_in_the_profile_is_that_of_the_fan_as_well() -> None:
    """A slow gain of +6 dB in the middle: the louder fan behind it is what the profile, which knows the gain, expects."""
    x = voice(10.0)
    gain_db = 6 * np.hanning(400)
    n = np.arange(x.size) * 40 / 16000
    recording = (record(x) * 10 ** (np.interp(n, np.arange(400), gain_db) / 20)).astype(np.float32)
    plain = profile()
    known = plain.with_echo(plain.echo.with_effect("mic_agc", {"gain_db": gain_db, "knots_hz": 40.0}))
    found = compare(known, recording, x)
    assert compare(plain, recording, x).excess_db > 3.0
    assert abs(found.excess_db) < 0.3 and abs(found.silence_excess_db) < 0.3
    assert max(abs(excess) for _, _, excess in found.bands) < 1.0
    np.testing.assert_allclose(found.recording - found.prediction, found.residual, atol=1e-6)


@pytest.mark.parametrize(("level_db", "talks"), [(7.5, False), (8.5, True)])
def test_a_talker_is_eight_decibels_over_the_fan(level_db: float, talks: bool) -> None:
    square = np.ones(10 * 16_000)
    square[3 * 16_000 : 4 * 16_000] = 10 ** (level_db / 10)
    found = find_talk(square, np.zeros(square.size, bool))
    assert found == (((pytest.approx(2.8), pytest.approx(4.2)),) if talks else ())
    assert find_talk(square, np.ones(square.size, bool)) == ()  # it is the robot
