"""Live parts on the least that they take: what is recorded anew, bookkeeping, verdicts, and each part from end to end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from bench import __main__ as bench
from bench import closed_loop
from bench.closed_loop import Output
from bench.live import barge_in, soak, virtual_sound
from bench.live.barge_in import early_errors, lasts, lowered, muted, silent_at, words
from bench.metrics import first_sound
from bench.recogniser import Recogniser
from bench.simulate import microphones, monologues
from bench.simulate.conversations import Scene, make_scene, read_clips, read_voices
from bench.simulate.simulated_robot import Room, draw_robot, draw_walls, stand
from edgefilter import Event
from tests.bench.conftest import RATE, babble, driven
from tests.program import DEMO


def run(output: Path, part: str, *arguments: object) -> tuple[dict, str]:
    """A part of the JSON file, and the page."""
    assert bench.main(["live", part, "--output", str(output), *map(str, arguments)]) == 0
    parts = json.loads(output.with_suffix(".json").read_text())["parts"]
    return parts[part.replace("-", "_")], output.with_suffix(".md").read_text()


def test_a_part_says_which_folder_it_needs(clips: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["live", "barge-in", "--voices", str(clips)]) == 1
    assert (
        capsys.readouterr().err == "bench live: the part 'barge-in' needs --speech, a folder with a transcripts.tsv\n"
    )


# ---------------------------------------------------------------- long recordings


def test_an_utterance_is_in_the_echo_after_the_lag_at_its_volume_and_by_its_clock() -> None:
    robot = draw_robot(np.random.default_rng(3))
    response = np.eye(1, 100)[0]

    def echo(**how: float) -> np.ndarray:
        voice, room = iter([babble(3.0, 1).astype(float)]), Room(0.2, response, response)
        return monologues.speak(np.random.default_rng(0), robot, voice, 1.0, room, **{"lag": 800, **how})[1]

    plain = echo()
    assert not plain[: RATE // 2 + 800 + robot.bulk - 40].any() and plain.any()
    assert np.allclose(echo(lag=1000)[200:], plain)
    assert np.std(echo(volume_db=-20.0)) == pytest.approx(0.1 * np.std(plain), rel=0.05)  # the driver is not linear
    span = slice(40_000, 48_000)
    late = np.argmax(np.correlate(echo(ppm=-1000.0)[span], plain[span], "full")) - 7999
    assert late == pytest.approx(44, abs=4)  # 1000 ppm of 40000 to 48000 samples


def test_a_robot_driven_elsewhere_stays_in_its_room() -> None:
    rng, direction = np.random.default_rng(1), np.array([0.6, 0.0, -0.8])
    walls = draw_walls(rng, "lab")
    here, there = (stand(rng, walls, 0.2, direction, 1.2) for _ in range(2))
    assert here.rt60_s == pytest.approx(there.rt60_s, rel=0.15) and not np.allclose(here.robot[:800], there.robot[:800])
    assert np.argmax(np.abs(here.robot)) == np.argmax(np.abs(there.robot))  # its loudspeaker went along


@pytest.mark.slow
def test_half_a_minute_of_audio_does_not_drift(tmp_path: Path) -> None:
    found, page = run(tmp_path / "live", "soak", "--minutes", 0.5, "--engine", "ss")
    assert found["samples_in"] == found["samples_out"] == 30 * 16000 and len(found["slices"]) == soak.SLICES
    assert "nothing drifted" in page and (tmp_path / "live_soak.png").stat().st_size > 5_000


def test_what_the_processes_of_a_process_take_is_counted_with_theirs() -> None:
    busy = "import time\nwhile time.process_time() < 0.3: pass\nprint(flush=True); input()"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {busy!r}])"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        (own,) = virtual_sound.children(process.pid)
        assert process.pid in virtual_sound.children(os.getpid()) and own in virtual_sound.children(os.getpid())
        assert 0.2 < virtual_sound.processor_s(own) < 1.0 and virtual_sound.memory_mb(own) > 1.0
        process.communicate(b"\n")
    assert virtual_sound.processor_s(own) == virtual_sound.memory_mb(own) == 0.0 and not virtual_sound.children(own)


def test_the_lag_of_the_long_run_comes_back() -> None:
    hours = 3600 * 16000 * np.arange(4)
    np.testing.assert_allclose(soak.ahead(hours), [0, 2880, 0, 2880])  # 50 ppm of an hour's samples


def test_a_leak_lost_samples_and_slowing_down_are_found() -> None:
    def result(learner: bool = False, **changes: object) -> dict:
        kinds = (
            {"learner_mb": 60.0, "learner_cpu_s_a_minute": 5.0}
            if learner
            else {"p50_ms": 1.0, "p99_ms": 2.0, "bypass_ms": 0.1}
        )
        slices = [{"seconds": 60 * i, "memory_mb": 60.0, **kinds} for i in range(20)]
        return {"samples_in": 100, "samples_out": 100, "lost": 0, "slices": slices, **changes}

    assert soak.drifts(result()) == []
    assert soak.drifts(result(samples_out=99)) == ["100 samples in, 99 out"]
    assert soak.drifts(result(lost=3)) == ["3 samples lost"]
    assert soak.drifts(result(not_finite=2)) == ["2 samples are no numbers"]
    assert soak.drifts(result(diverged=1)) == ["1 divergences"]
    leaking, slowing, throttled, bimodal = (result() for _ in range(4))
    for number in range(20):
        for key in ("p50_ms", "bypass_ms"):
            throttled["slices"][number][key] *= 1 + 0.1 * number
        leaking["slices"][number]["memory_mb"] += number
        slowing["slices"][number]["p50_ms"] += 0.1 * number
        bimodal["slices"][number]["p50_ms"] = 1.6 if number % 2 == number // 10 else 1.0
    assert soak.drifts(leaking) == ["memory grew by 17.0 MB"]
    assert "in the second half" in soak.drifts(slowing)[0]
    assert soak.drifts(bimodal) == []  # the robot spoke in five slices of one half and in four of the other
    assert soak.drifts(throttled) == []  # the machine became slower, not the filter
    live = result(learner=True)
    live["slices"][0]["learner_mb"] = 0.0  # it comes when it is called
    live["slices"][1]["learner_cpu_s_a_minute"] = 20.0  # its first fits
    assert soak.drifts(live) == [] and live["learner_growth_mb"] == 0.0
    assert live["learner_cpu_s_a_minute_once_settled"] == 5.0
    for one in live["slices"][3::2]:
        one["learner_mb"] += 150.0  # within a round
    assert soak.drifts(live) == []
    for one in live["slices"][15:]:
        one["learner_mb"] += 60.0
    assert soak.drifts(live) == ["the learner's memory grew by 60.0 MB"]


# ---------------------------------------------------------------- barge-in in closed loop


@pytest.fixture(scope="module")
def scene(clips: Path) -> Scene:
    with driven():
        return make_scene(3, 0, "live", read_clips(clips, (3.0, 12.0)), read_voices([clips]))


@pytest.fixture(scope="module")
def echo(scene: Scene) -> np.ndarray:
    return scene.echo(scene.signals["ref"])


@pytest.mark.slow
def test_a_scene_recorded_again_is_the_same_up_to_the_stop_and_without_the_robot_behind_it(
    scene: Scene, echo: np.ndarray
) -> None:
    ref, meta = scene.signals["ref"], scene.meta
    np.testing.assert_allclose(echo + scene.signals["clean"] + scene.fan, scene.signals["mic"], atol=1e-12)
    at = meta["t_main"] + RATE
    stopped = scene.echo(lowered(ref, at, 0.0))
    reached = round(at + meta["lag2"] + meta["delay"] - abs(meta["ppm"]) * 1e-6 * ref.size)
    before = slice(0, reached - RATE // 50)  # the clocks' resampling and the loudspeaker's filters look ahead
    np.testing.assert_allclose(stopped[before], echo[before], atol=1e-6)
    behind = slice(reached + RATE // 2, None)  # the laboratory calms down by 60 dB in 0.26 s
    assert np.abs(echo[behind]).max() > 0.05 and np.abs(stopped[behind]).max() < 1e-4


@pytest.mark.slow
def test_a_ducked_robot_is_quieter_by_so_much(scene: Scene) -> None:
    ref = scene.signals["ref"]
    ducked = lowered(ref, RATE, 10 ** (-10 / 20))
    assert np.array_equal(ducked[:RATE], ref[:RATE])
    np.testing.assert_allclose(ducked[RATE + RATE // 10 :], 10**-0.5 * ref[RATE + RATE // 10 :])


@pytest.mark.slow
def test_the_oracle_is_silent_when_the_human_begins(scene: Scene, echo: np.ndarray) -> None:
    onset = first_sound(scene.signals["clean"].astype(np.float32))
    left = scene.echo(lowered(scene.signals["ref"], silent_at(scene, onset), 0.0))
    assert np.abs(left[onset - RATE // 2 : onset - RATE // 20]).max() > 0.02
    assert np.abs(left[onset + RATE // 4 :]).max() < 0.01 * np.abs(echo[onset:]).max()


@pytest.mark.slow
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
    assert (found["whole"], found["first"]) == (pytest.approx(100 * 2 / 7), 100.0)


def test_speech_lasts_until_a_pause_of_a_fifth_of_a_second() -> None:
    def talk(*parts: tuple[float, float]) -> Output:
        hops = [[probability] * round(seconds * RATE / 256) for seconds, probability in parts]
        return Output(np.zeros(0, np.float32), [], sum(hops, []), 256)

    assert lasts(talk((2.0, 0.1)), RATE) is None
    assert lasts(talk((1.0, 0.1), (0.2, 1.0), (1.0, 0.1)), RATE) == [True, False, False, False]
    assert lasts(talk((1.0, 0.1), (2.0, 1.0)), RATE) == [True] * 4
    assert lasts(talk((1.0, 0.1), (0.2, 1.0), (0.1, 0.1), (0.6, 1.0), (1.0, 0.1)), RATE) == [True, True, True, True]


def test_a_recorded_robot_is_lowered_as_late_as_it_is_found() -> None:
    mic, ref = (soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0][: 7 * RATE] for name in ("mic", "reference"))
    robot = closed_loop.recorded(mic, ref, 12.0)
    assert robot is not None and robot.late == pytest.approx(2288, abs=48) and robot.ask_db == 12.0
    assert closed_loop.recorded(mic[::-1].copy(), ref, 12.0) is None


@pytest.mark.slow
def test_interruptions_and_false_stops_from_end_to_end(
    scene: Scene, clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def listen(mic: np.ndarray, ref: np.ndarray, profile: object, engine: str, robot: object) -> Output:
        """A filter that notices the human after 0.1 s if the robot is as loud as ever, and passes the microphone."""
        asked.append(ref)
        onset = first_sound(scene.signals["clean"].astype(np.float32)) + RATE // 10
        probability = [float(at > onset) for at in range(256, mic.size, 256)]
        return Output(mic.astype(np.float32), [Event("speech_started", onset, "sure")], probability, 256)

    class Listener(Recogniser):
        """Understands whatever is not silent."""

        identity = "listener"

        def __init__(self, *of: object) -> None: ...

        def transcribe(self, samples: np.ndarray) -> str:
            return "some words here" if np.abs(samples).max() > 0 else ""

    monkeypatch.setattr(barge_in, "Recogniser", Listener)
    monkeypatch.setattr(barge_in, "make_scene", lambda *of, **more: scene)
    monkeypatch.setattr(barge_in, "listen", listen)
    options = ["--voices", clips, "--speech", clips, "--count", 1, "--alone", clips, "--minutes", 0.05]
    options += ["--whisper", clips, "--cache", tmp_path]
    with driven():
        found, page = run(tmp_path / "live", "barge-in", *options)
    (interruption,), (alone,) = found["conversations"], found["alone"]
    assert set(interruption["words"]) == set(barge_in.POLICIES)
    assert interruption["calibrated"]["delay_s"] == 0.1 and "| calibrated | 1 | 100 [21, 100] | 0.10 | 0.10 |" in page
    stopped, ducked, silent = asked[-4:-1]
    stop = first_sound(scene.signals["clean"].astype(np.float32)) + round(0.17 * RATE)
    assert not stopped[stop:].any() and np.abs(ducked[stop:]).max() > 0.1 and not silent[stop:].any()
    assert 3.0 <= alone["speech_s"] < 7.0 and alone["stops"] == 1
    assert "| closed loop: stopped by the event | 0 | 0 |" in page
    assert (tmp_path / "live_barge_in.png").stat().st_size > 5000
    asked.clear()
    again, _ = run(tmp_path / "live", "barge-in", *options)  # every row is known
    assert not asked and again["tables"] == found["tables"]


class Asking:
    """A filter that passes the microphone, asks from its tenth hop on, for ten hops, and adds what it hears, (mic, ref), to `heard`."""

    hop, speech_probability = 256, 0.0

    def __init__(self, heard: list[tuple[np.ndarray, np.ndarray]]) -> None:
        self.heard = heard

    @property
    def voice_gain(self) -> float:
        return 0.25 if 10 <= len(self.heard) < 20 else 1.0

    def process(self, mic: np.ndarray, ref: np.ndarray) -> np.ndarray:
        self.heard.append((mic, ref))
        return mic

    def events(self) -> list[Event]:
        return []

    def flush(self) -> np.ndarray:
        return np.zeros(0, np.float32)


def test_a_robot_that_asks_is_heard_lower_as_late_as_its_sound_comes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    heard = []
    monkeypatch.setattr(closed_loop, "EgoFilter", lambda *of, **more: Asking(heard))
    ones, late = np.ones(50 * 256, np.float32), 5 * 256
    closed_loop.listen(1.5 * ones, ones, None, "crnn", closed_loop.Robot(ones, late, 12.0, tmp_path / "it.wav"))
    mic, ref = (np.concatenate(part) for part in zip(*heard))
    written, _ = soundfile.read(tmp_path / "it.wav")
    np.testing.assert_allclose(written, np.clip(np.stack((ref, mic), axis=1), -1.0, 1.0), atol=1e-4)
    lowered = np.flatnonzero(ref < 0.3)
    assert 10 * 256 < lowered[0] < 11 * 256 and 20 * 256 <= lowered[-1] < 21 * 256
    np.testing.assert_allclose(mic[late:], 0.5 + ref[:-late], atol=1e-6)


def test_a_robot_that_asks_behind_a_device_is_heard_through_it(monkeypatch: pytest.MonkeyPatch) -> None:
    heard = []
    monkeypatch.setattr(closed_loop, "EgoFilter", lambda *of, **more: Asking(heard))
    mic, device = babble(2.0, 3).astype(np.float32), microphones.Processing(10.0, 0.5, -30.0)
    robot = closed_loop.Robot(np.zeros_like(mic), 0, 0.0, device=device)
    out = closed_loop.listen(mic, mic, None, "crnn", robot)
    expected, through = device.whole(mic)[0][: -microphones.LATE], np.concatenate([one for one, _ in heard])
    np.testing.assert_allclose(through[microphones.LATE :], expected, atol=1e-6)
    assert np.array_equal(out.samples, through) and not np.allclose(expected, mic[: expected.size], atol=1e-3)


@pytest.mark.slow
def test_a_lowered_loudspeaker_distorts_less_and_a_monologue_says_so(clips: Path) -> None:
    voices = read_voices([clips])
    name = min(voices)
    with driven():
        plain, asked, processed = (
            monologues.make_monologue(4, 2, name, iter(voices[name]), 2.0, *of)  # strong distortion
            for of in ((), (12.0,), (0.0, "processed"))
        )
    assert np.array_equal(plain.mic, asked.mic) and np.array_equal(plain.mic, processed.mic)
    left = plain.echo - 0.75 * asked.echo  # what is heard with the gain at 0.25
    gain = float(left @ plain.echo / (plain.echo @ plain.echo))
    assert 0.2 < gain < 0.4 and np.std(left - gain * plain.echo) > 0.01 * np.std(left)
    assert plain.device is None and not np.allclose(processed.calibration[1], plain.calibration[1], atol=1e-4)


def test_no_stop_in_half_an_hour_says_at_most_seven_an_hour() -> None:
    assert [barge_in.synthesiser(voice) for voice in ("espeak-en-gb+m3", "af_bella", "real-recorded")] == [
        "espeak",
        "neural",
        "real",
    ]
    row = {
        "speech_s": 1800.0,
        "stops": 0,
        "suspected": 3,
        "asked": 2,
        "said": [["a", 900.0], ["a", 900.0]],
        "voice": "v",
    }
    robots, minutes, distinct, voices, count, rate, *asked = barge_in.false_stops([row])
    assert (robots, minutes, distinct, voices, count, asked) == (1, 30.0, 15.0, 1, 0, [3, 2])
    assert rate["mean"] == rate["low"] == 0.0
    assert rate["high"] == pytest.approx(3.689 / 0.5, abs=0.01)  # the exact bound of a count of 0, Garwood 1936
