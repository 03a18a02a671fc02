"""Barge-in in closed loop: what is recorded anew, what is counted, and the whole program on next to nothing."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from bench.measure.real_barge_in import first_sound
from bench.measure.recogniser import Recogniser

from bench.measure import closed_loop, closed_loop_report, closed_loop_scenes
from bench.measure.closed_loop_scenes import Talk, early_errors, lasts, lowered, muted, silent_at, words
from bench.simulate.conversations import Scene, make_scene, read_clips, read_voices
from edgefilter import Event
from tests.bench.conftest import RATE


@pytest.fixture(scope="module")
def scene(clips: Path) -> Scene:
    return make_scene(3, 0, "live", read_clips(clips, (3.0, 12.0)), read_voices([clips]))


@pytest.fixture(scope="module")
def echo(scene: Scene) -> np.ndarray:
    return scene.echo(scene.signals["ref"])


def test_a_scene_recorded_again_is_the_same_up_to_the_stop_and_without_the_robot_behind_it(
    scene: Scene, echo: np.ndarray
) -> None:
    ref, meta = scene.signals["ref"], scene.meta
    np.testing.assert_allclose(echo + scene.signals["clean"] + scene.fan, scene.signals["mic"], atol=1e-12)
    at = meta["t_main"] + RATE
    stopped = scene.echo(lowered(ref, at, 0.0))
    heard_from = round(at + meta["lag2"] + meta["delay"] - abs(meta["ppm"]) * 1e-6 * ref.size)
    before = slice(0, heard_from - RATE // 50)  # the clocks' resampling and the loudspeaker's filters look ahead
    np.testing.assert_allclose(stopped[before], echo[before], atol=1e-6)
    behind = slice(heard_from + RATE // 2, None)  # the laboratory calms down by 60 dB in 0.26 s
    assert np.abs(echo[behind]).max() > 0.05 and np.abs(stopped[behind]).max() < 1e-4


def test_a_ducked_robot_is_quieter_by_so_much(scene: Scene) -> None:
    ref = scene.signals["ref"]
    ducked = lowered(ref, RATE, 10 ** (-10 / 20))
    assert np.array_equal(ducked[:RATE], ref[:RATE])
    np.testing.assert_allclose(ducked[RATE + RATE // 10 :], 10**-0.5 * ref[RATE + RATE // 10 :])


def test_the_oracle_is_silent_when_the_human_begins(scene: Scene, echo: np.ndarray) -> None:
    onset = first_sound(scene.signals["clean"].astype(np.float32))
    left = scene.echo(lowered(scene.signals["ref"], silent_at(scene, onset), 0.0))
    assert np.abs(left[onset - RATE // 2 : onset - RATE // 20]).max() > 0.02
    assert np.abs(left[onset + RATE // 4 :]).max() < 0.01 * np.abs(echo[onset:]).max()


def test_a_muted_microphone_is_silent_while_the_robot_speaks(scene: Scene, echo: np.ndarray) -> None:
    found = muted(scene)
    assert not found[np.abs(echo) > 0.1 * np.abs(echo).max()].any() and found[-RATE // 10 :].any()


def test_errors_are_counted_in_the_first_words_alone() -> None:
    spoken = "please stop talking and listen to me".split()
    assert early_errors(spoken, spoken, 3) == 0
    assert early_errors(spoken, [], 3) == 3
    assert early_errors(spoken, "talking and listen to me".split(), 3) == 2
    assert early_errors(spoken, "please stop talking and listening too".split(), 3) == 0
    assert early_errors(spoken, "well well please stop talking and listen to me".split(), 3) == 2
    found = words("please stop talking and listen to me", "talking and listen to me", 0.4)
    assert (found["errors"], found["first_errors"], found["first_words"]) == (2, 2, 2)


def test_speech_lasts_until_a_pause_of_a_fifth_of_a_second() -> None:
    def talk(*parts: tuple[float, float]) -> Talk:
        hops = [[probability] * round(seconds * RATE / 256) for seconds, probability in parts]
        return Talk(np.zeros(0, np.float32), [], sum(hops, []), 256)

    assert lasts(talk((2.0, 0.1)), RATE) is None
    assert lasts(talk((1.0, 0.1), (0.2, 1.0), (1.0, 0.1)), RATE) == [True, False, False, False]
    assert lasts(talk((1.0, 0.1), (2.0, 1.0)), RATE) == [True] * 4
    assert lasts(talk((1.0, 0.1), (0.2, 1.0), (0.1, 0.1), (0.6, 1.0), (1.0, 0.1)), RATE) == [True, True, True, True]


def test_the_program_runs_to_its_tables_and_its_picture(
    scene: Scene, clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def listen(mic: np.ndarray, ref: np.ndarray, profile: object, engine: str) -> Talk:
        """A filter that notices the human after 0.1 s if the robot is as loud as ever, and passes the microphone."""
        asked.append(ref)
        onset = first_sound(scene.signals["clean"].astype(np.float32)) + RATE // 10
        probability = [float(at > onset) for at in range(256, mic.size, 256)]
        return Talk(mic.astype(np.float32), [Event("speech_started", onset, "sure")], probability, 256)

    monkeypatch.setattr(Recogniser, "__init__", lambda self, folder, cache: None)
    monkeypatch.setattr(Recogniser, "transcribe", lambda self, x: "some words here" if np.abs(x).max() > 0 else "")
    monkeypatch.setattr(closed_loop, "make_scene", lambda *of: scene)
    monkeypatch.setattr(closed_loop_scenes, "listen", listen)
    arguments = ["--speech", clips, "--voices", clips, "--count", 1, "--alone-voices", clips, "--minutes", 0.05]
    arguments += ["--output", tmp_path / "closed", "--whisper", clips, "--cache", tmp_path]
    monkeypatch.setattr(sys, "argv", ["closed_loop", *map(str, arguments)])
    assert closed_loop.main() == 0
    found, page = json.loads((tmp_path / "closed.json").read_text()), (tmp_path / "closed.md").read_text()
    (interruption,), (alone,) = found["rows"], found["alone"]
    assert set(interruption["heard"]) == set(closed_loop_report.POLICIES)
    assert interruption["calibrated"]["delay_s"] == 0.1 and "| calibrated | 1 | 100 % |" in page
    stopped, ducked, silent = asked[-3:]
    stop = first_sound(scene.signals["clean"].astype(np.float32)) + round(0.17 * RATE)
    assert not stopped[stop:].any() and np.abs(ducked[stop:]).max() > 0.1 and not silent[stop:].any()
    assert 3.0 <= alone["speech_s"] < 7.0 and found["summary"]["false_stops"]["all"]["stops"] == alone["stops"]
    assert "| closed loop: stopped by the event | 0 [0, 0] |" in page
    assert (tmp_path / "closed.png").stat().st_size > 5000
    asked.clear()
    assert closed_loop.main() == 0  # again: every row is known
    assert not asked and json.loads((tmp_path / "closed.json").read_text())["summary"] == found["summary"]


def test_no_stop_in_half_an_hour_says_at_most_seven_an_hour() -> None:
    assert [
        closed_loop_report.synthesiser({"voice": voice, "source": source})
        for voice, source in (("espeak-en-gb+m3", "simulated"), ("af_bella", "simulated"), ("recorded", "real"))
    ] == ["espeak", "neural", "real"]
    row = {"speech_s": 1800.0, "stops": 0, "said": [["a", 900.0], ["a", 900.0]], "voice": "v"}
    found = closed_loop_report.false_stops([row])
    assert found["per_hour"] == 0.0 and found["interval"][0] == 0.0
    assert found["interval"][1] == pytest.approx(3.689 / 0.5, abs=0.01)  # the exact bound of a count of 0, Garwood 1936
    assert found["distinct_minutes"] == 15.0
