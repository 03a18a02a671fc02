"""`edgefilter passport` as typed: what it finds on devices that are known, what it says first, and wrong input."""

from __future__ import annotations

import json

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from edgefilter.diagnosis.passport import expected, measure
from edgefilter.dsp.fractional_delay import interpolate
from edgefilter.errors import SignalError
from edgefilter.report.passport import advice
from edgefilter.types import SAMPLE_RATE as RATE
from tests.diagnosis.robot_scene import DELAY, record, voice

SECONDS = 11.0


@pytest.fixture(scope="module")
def clean():
    """Reference and microphone of a robot in a small room that pauses after six seconds; its fan is at -60 dBFS."""
    said = voice(SECONDS)
    said[6 * RATE : 7 * RATE] = 0.0
    return said, record(said)


@pytest.fixture
def passport(tmp_path, capsys):
    """A function that writes both channels, runs the command and returns its code, figures, lines and page."""

    def run(mic, ref, *more, engine="linear", diagnosis=False):
        soundfile.write(tmp_path / "mic.wav", mic, RATE, "FLOAT")
        soundfile.write(tmp_path / "ref.wav", ref, RATE, "FLOAT")
        words = ["passport", "--recording", tmp_path / "mic.wav", "--reference", tmp_path / "ref.wav"]
        words += ["--json", tmp_path / "p.json", "--report", tmp_path / "p.html", *more]
        words += ["--engine", engine] if engine else []
        words += [] if diagnosis else ["--no-diagnosis"]
        code = main([str(word) for word in words])
        said = capsys.readouterr()
        if code:
            assert not (tmp_path / "p.json").exists() and not (tmp_path / "p.html").exists()
            return code, {}, said.err, ""
        page = (tmp_path / "p.html").read_text()
        return code, json.loads((tmp_path / "p.json").read_text()), said.out, page

    return run


@pytest.mark.slow
def test_a_device_that_is_linear_is_told_as_it_is(passport, clean):
    said, heard = clean
    code, figures, out, page = passport(heard, said, engine=None)
    assert code == 0 and figures["schema"] == 1
    assert figures["lag_ms"] == pytest.approx(1000 * DELAY / RATE, abs=0.1) and figures["sharp"] == 1.0
    assert figures["lag_spread_ms"] < 0.1 and figures["drift_ppm"] == 0.0
    assert figures["noise_db"] == pytest.approx(-60.0, abs=1.0)  # robot_scene.FAN
    assert figures["mic_db"] == pytest.approx(10 * np.log10(np.mean(heard**2)), abs=0.01)
    assert figures["cause"] == "nothing" and figures["said"]["changes"] == ["Nothing needs to be changed."]
    assert set(figures["engines"]) == {"linear", "ss", "crnn"} and figures["diagnosis"] is None
    for told in figures["engines"].values():
        assert told["si_sdr_before_db"] == pytest.approx(-10.0, abs=0.5)  # voice and robot are nearly uncorrelated
        assert told["si_sdr_db"] > told["si_sdr_before_db"] + 10 and told["removed_db"] > 15
    of_all_octaves = sum(10 ** (band["mic_db"] / 10) for band in figures["bands"])
    assert -2.0 < 10 * np.log10(of_all_octaves) - figures["mic_db"] < 0.0  # what lies below 88 Hz is in none
    removed = [band["removed_db"]["linear"] for band in figures["bands"]]
    assert removed[0] > removed[-1] + 8  # the fan is white, the voice is not
    for words in (figures["said"]["headline"], "other humans' SI-SDR differed", "Nothing needs to be changed."):
        assert words in out and words.replace("'", "&#39;") in page
    assert page.count("<rect") == 4 * len(figures["bands"]) and "://" not in page


@pytest.mark.slow
def test_what_is_removable_is_what_distortion_and_noise_leave(passport, clean):
    said, heard = clean
    noise = np.random.default_rng(5).standard_normal(heard.size) * np.sqrt(np.mean(heard**2) / 10**0.5)
    _, noisy, out, _ = passport((heard + noise).astype(np.float32), said)
    # robot over noise 5 dB, so that (robot + noise) / noise = 6.2 dB
    assert noisy["removable_db"] == pytest.approx(6.2, abs=0.7) and noisy["over_noise_db"] == pytest.approx(
        6.2, abs=0.7
    )
    assert noisy["cause"] == "noise" and "quieter" in noisy["said"]["changes"][0] and "in the robot's pauses" in out
    distorted = heard + 0.4 * np.sqrt(np.mean(heard**2) / np.mean(heard**4)) * heard**2
    changed = measure(distorted.astype(np.float32), said, said[:RATE], engines=[])
    assert changed.change_db == pytest.approx(20 * np.log10(0.4), abs=1.5) and changed.cause == "change"
    assert changed.follows > noisy["follows"]


@pytest.mark.slow
def test_what_is_removable_is_not_overrated_where_the_robot_says_little():
    """Two seconds of ten, beside a sound as loud that follows nothing: so few frames agree with anything by chance."""
    rng = np.random.default_rng(0)
    said, other = 0.05 * rng.standard_normal((2, 10 * RATE)).astype(np.float32)
    said[2 * RATE :] = 0.0
    heard = np.roll(said, DELAY)
    heard += other * (heard != 0.0)
    found = measure(heard, said, said[:RATE], engines=[])
    assert found.removable_db == pytest.approx(10 * np.log10(2.0), abs=0.8)  # 4.5 dB with what chance explains


def test_a_microphone_that_shuts_is_named_as_processed(passport, clean):
    said, heard = clean
    level = np.sqrt(np.convolve(heard**2, np.ones(320) / 320, "same"))
    gain = 0.05 / np.maximum(level, 0.05) * (level > 0.02)
    code, figures, out, page = passport((heard * gain).astype(np.float32), said)
    shut, played = (np.any(x.reshape(-1, RATE // 50), axis=1) for x in (heard * gain, said))
    assert code == 0 and figures["cause"] == "gate" and figures["gated"] > 0.05
    assert figures["gated"] == pytest.approx(np.mean(~shut & played), abs=0.005)  # not where the robot itself is silent
    assert (
        "it is processed" in out and "noise suppression" in figures["said"]["changes"][0] and "it is processed" in page
    )


@pytest.mark.slow
def test_clocks_that_drift_are_told_and_straightened(clean):
    said, _ = clean
    drifting = record(interpolate(said, np.arange(said.size) * (1 + 150e-6)))
    found = measure(drifting, said, said[:RATE], engines=[])
    assert found.drift_ppm == pytest.approx(150.0, abs=6.0) and found.removable_db > 10
    assert any("clocks" in change for change in advice(found))


def test_a_lag_that_jumps_is_told_with_how_far(clean):
    said, heard = clean
    at, moved = 6 * RATE, 240
    found = measure(np.concatenate((heard[:at], heard[at - moved : -moved])), said, said[:RATE], engines=[])
    assert found.lag_spread_ms == pytest.approx(1000 * moved / RATE, abs=0.3)
    assert found.sharp == 10 / 11  # behind the jump the robot is silent for a second, whose lag nobody knows


@pytest.mark.slow
def test_a_microphone_that_is_overdriven_is_named_where_that_is_what_bounds_the_filter(clean):
    said, heard = clean
    found = measure(np.clip(heard / 0.02, -1.0, 1.0).astype(np.float32), said, said[:RATE], engines=[])
    assert found.cause == "clipping" and found.mic_peak_db == 0.0
    assert found.clipped == pytest.approx(np.mean(np.abs(heard) >= 0.02), abs=0.001)


def test_a_reference_of_another_recording_and_swapped_files_are_refused_with_the_likely_cause(passport, clean):
    """The first was a finding with exit code 0, in the second the microphone was blamed."""
    said, heard = clean
    for files, cause in (((record(voice(SECONDS, seed=9)), said), "another recording"), ((said, heard), "swapped")):
        code, _, err, _ = passport(*files)
        (line,) = [each for each in err.splitlines() if each.startswith("edgefilter: ")]
        assert code == 1 and cause in line


@pytest.mark.slow
def test_a_robot_that_never_pauses_is_asked_for_a_pause(passport):
    said = (0.05 * np.random.default_rng(2).standard_normal(round(SECONDS * RATE))).astype(np.float32)
    _, figures, out, _ = passport(record(said), said)
    assert not figures["pauses"] and "at most" in out
    assert any("pause" in change for change in figures["said"]["changes"])


@pytest.mark.slow
def test_the_level_of_the_human_is_the_one_asked_for(passport, clean):
    said, heard = clean
    _, figures, out, _ = passport(heard, said, "--human-db", "0")
    assert figures["engines"]["linear"]["si_sdr_before_db"] == pytest.approx(0.0, abs=0.5) and "as loud as" in out
    before, after = expected(heard, said, voice(2.0, seed=7), -6.0, "bypass")
    assert before == pytest.approx(-6.0, abs=0.5) and after == pytest.approx(before, abs=1e-3)  # float32


def spoken_over(mic: np.ndarray, human: np.ndarray) -> float:
    """SI-SDR, dB, of a human laid on at -6 dB, before any engine."""
    return expected(mic.astype(np.float32), 0 * mic, human.astype(np.float32), -6.0, "bypass")[0]


@pytest.mark.parametrize(("left_s", "counts"), [(2.0, True), (2.0 - 1 / RATE, False)])
def test_a_turn_that_the_end_leaves_less_than_two_seconds_of_does_not_count(left_s, counts):
    """The first three seconds are from 5 s on, the next from 10 s on: there the microphone holds the same, which raises the mean."""
    rng = np.random.default_rng(0)
    human, mic = rng.standard_normal(3 * RATE), 0.1 * rng.standard_normal(13 * RATE)
    mic[10 * RATE :] = 0.1 * human
    found = spoken_over(mic[: round((10.0 + left_s) * RATE)], human)
    assert found > 20.0 if counts else found == pytest.approx(-6.0, abs=0.5)  # two noises of 3 s


def test_a_turn_in_which_the_microphone_is_silent_does_not_count():
    rng = np.random.default_rng(0)
    human, mic = rng.standard_normal(3 * RATE), 0.1 * rng.standard_normal(13 * RATE)
    mic[: 9 * RATE] = 0.0
    assert spoken_over(mic, human) == pytest.approx(-6.0, abs=0.5)


@pytest.mark.slow
def test_the_diagnosis_is_in_the_passport_unless_it_is_left_out(passport, clean):
    said, heard = clean
    _, figures, out, page = passport(np.clip(heard, -0.04, 0.04), said, diagnosis=True)
    assert [one["effect"] for one in figures["diagnosis"]["ranking"]] != []
    assert figures["said"]["diagnosis"] in out and figures["said"]["diagnosis"] in page


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda mic, ref: (mic[: 9 * RATE], ref[: 9 * RATE]), "9.0 s long, expected 10 to 60 s"),
        (lambda mic, ref: (mic[:RATE // 2], ref), "0.50 s long"),
        (lambda mic, ref: (mic, 0 * ref), "the reference is silent"),
        (lambda mic, ref: (0 * mic, ref), "the recording is silent"),
        (lambda mic, ref: (np.pad(mic, (60 * RATE, 0)), np.tile(ref, 7)), "the recording is silent in the first 60 s"),
    ],
)  # fmt: skip
def test_too_short_or_silent_is_one_line_and_exit_code_1(passport, clean, change, words):
    said, heard = clean
    code, _, err, _ = passport(*change(heard, said))
    lines = [line for line in err.splitlines() if line.startswith("edgefilter: ")]
    assert code == 1 and len(lines) == 1 and words in lines[0]


def test_of_signals_too_the_first_minute_alone_is_looked_at(clean):
    said, heard = clean
    with pytest.raises(SignalError, match="the recording is silent in the first 60 s"):
        measure(np.pad(heard, (60 * RATE, 0)), np.tile(said, 7), said, engines=[])


@pytest.mark.parametrize(
    ("more", "words"),
    [(["--human-db", "99"], "a level from -40 to 20 dB"), (["--engine", "paper-ss"], "invalid choice")],
)
def test_an_option_that_cannot_be_is_refused(passport, clean, more, words):
    said, heard = clean
    code, _, err, _ = passport(heard, said, *more)
    assert code == 2 and words in err
