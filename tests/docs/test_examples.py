"""Every program in docs/examples, run as its first lines say, on recordings that the repository has."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from docs.draw_belief import CELL, believed, draw
from edgefilter.alignment.aligner import LATEST
from edgefilter.session import level_db as db
from edgefilter.types import SAMPLE_RATE as RATE
from tests.program import DEMO, ROOT, argv

EXAMPLES = ROOT / "docs/examples"
CALIBRATION = ROOT / "tests/data/demo_calibration"
REVERBERANT = ROOT / "tests/data/hidden/dev/11"
"""A simulated robot that was carried into a reverberant room after its calibration."""
ELSEWHERE = {"agent_pipecat.py", "agent_livekit.py", "agent_wyoming.py", "satellite.py"}
"""Whose conversation tests/integrations runs."""


def run(name, *words, stdin=None):
    """What the example prints, and says on standard error."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *map(str, words)], input=stdin, capture_output=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout, done.stderr.decode()


def read(path):
    return soundfile.read(path, dtype="float32")[0]


def test_the_picture_of_the_lag_shows_the_one_at_which_the_robot_is_heard(tmp_path):
    """It drew odds of its own, at lags that were wrong by two seconds, and failed on recordings with a lag that is long."""
    mic, reference = (read(DEMO / f"{name}.flac")[: 4 * RATE] for name in ("mic", "reference"))
    first = believed(np.pad(mic, (4 * RATE - 2288, 0))[: 8 * RATE], np.pad(reference, (0, 4 * RATE)))  # 4 s late
    assert first.max(axis=1).argmax() == (4 * RATE + LATEST) // CELL and first.max() > 0.99
    for name, sound in (("mic", mic), ("reference", reference)):
        soundfile.write(tmp_path / f"{name}.flac", sound, RATE)
    draw([str(tmp_path / "mic.flac"), str(tmp_path / "reference.flac")], tmp_path / "belief.png")
    assert (tmp_path / "belief.png").stat().st_size > 10_000


@pytest.fixture(scope="module")
def filtered(tmp_path_factory):
    """The bundled conversation as the example for files filters it."""
    path = tmp_path_factory.mktemp("filtered") / "human.wav"
    said, _ = run("filter_file.py", DEMO / "mic.flac", DEMO / "reference.flac", path, DEMO / "profile.npz")
    assert b"16.0 s filtered" in said
    return read(path)


def test_each_example_is_run_here_or_where_it_is_said():
    text = Path(__file__).read_text()
    names = {path.name for path in EXAMPLES.glob("*.py")} - ELSEWHERE
    assert len(names) >= 5 and set(re.findall(r'run\(\s*"(\w+\.py)"', text)) == names


def test_a_file_is_filtered(filtered):
    mic = read(DEMO / "mic.flac")
    alone = slice(1 * RATE, 5 * RATE)
    assert filtered.size == mic.size
    assert db(filtered[alone]) < db(mic[alone]) - 25  # the robot alone, 20 dB over its fan and more; 45 dB were seen


def test_blocks_through_a_pipe_give_the_same_and_tell_of_the_human(filtered):
    stereo = np.stack(
        [soundfile.read(DEMO / f"{name}.flac", dtype="int16")[0] for name in ("mic", "reference")], axis=1
    )
    out, said = run("pipe.py", DEMO / "profile.npz", stdin=stereo.astype("<i2").tobytes())
    np.testing.assert_allclose(np.frombuffer(out, "<i2") / 32768, filtered, atol=1.01 / 32768)  # 16 bits, rounded twice
    words = said.split()
    assert (
        words.count("speech_started") == 1 and 9.0 < float(words[0]) < 10.0
    )  # the human begins in the second after 9.0 s


def test_an_announced_utterance_is_found_and_removed(tmp_path):
    mic, reference = read(DEMO / "mic.flac"), read(DEMO / "reference.flac")
    soundfile.write(tmp_path / "mic.wav", mic[: 7 * RATE], RATE)
    soundfile.write(tmp_path / "said.wav", reference[round(0.42 * RATE) : round(6.1 * RATE)], RATE)
    said, _ = run(
        "announce.py", tmp_path / "mic.wav", tmp_path / "said.wav", tmp_path / "human.wav", DEMO / "profile.npz"
    )
    assert b"heard 1 of 1" in said
    speaking = slice(1 * RATE, 5 * RATE)
    assert db(read(tmp_path / "human.wav")[speaking]) < db(mic[speaking]) - 25  # as above


@pytest.mark.slow
def test_a_calibration_gives_a_profile_with_which_the_missing_effect_is_found_and_added(tmp_path):
    names = ("sweep_ref", "sweep_mic", "fan_only")
    said, _ = run("calibrate.py", *(REVERBERANT / f"{name}.flac" for name in names), tmp_path / "robot.npz")
    assert b"ms of impulse response" in said and said.count(b"dB over the fan") == 23, (
        "23 third-octave bands from 50 Hz to 8 kHz"
    )
    for name in ("mic", "ref"):
        soundfile.write(tmp_path / f"{name}.wav", read(REVERBERANT / f"{name}.flac")[: 10 * RATE], RATE)
    files = (tmp_path / f"{name}.wav" for name in ("mic", "ref"))
    said, _ = run("diagnose.py", tmp_path / "robot.npz", *files, tmp_path / "better.npz")
    lines = said.decode().splitlines()
    assert lines[1].startswith("missing") and lines[2].startswith("late_reverb: ")
    assert (
        float(lines[0].split()[0]) > 10 > 3 > float(lines[3].split()[-3])
    )  # dB before and after; 15.7 and 0.0 were seen
    assert (tmp_path / "better.npz").exists()


@pytest.mark.slow
def test_a_classifier_is_asked_whether_the_human_has_finished():
    said, _ = run("end_of_turn.py", DEMO / "mic.flac", DEMO / "reference.flac", DEMO / "profile.npz")
    told = [line.split(" s: ") for line in said.decode().splitlines()]
    assert told[0][1] == "begins" and 9.0 < float(told[0][0]) < 10.0
    assert told[-1][1] == "complete"


@pytest.fixture(scope="module")
def stereo():
    """The bundled conversation, 16-bit, microphone and reference."""
    return np.stack([soundfile.read(DEMO / f"{name}.flac", dtype="int16")[0] for name in ("mic", "reference")], axis=1)


def test_what_the_human_says_is_cut_out_behind_the_command_line(stereo, tmp_path):
    log = tmp_path / "events.jsonl"
    command = [*"run --input - --profile".split(), DEMO / "profile.npz", *"--output - --engine crnn --no-learn".split()]
    human = subprocess.run(
        argv(*map(str, command), "--quiet", "--log-json", log),
        input=stereo[6 * RATE :].astype("<i2").tobytes(), stdout=subprocess.PIPE, cwd=ROOT, check=True,
    )  # fmt: skip
    said, _ = run("listen.py", log, stdin=human.stdout)
    began, ended = re.fullmatch(r"(\S+) to (\S+) s: \(.* s\)\n", said.decode()).groups()
    assert 2.2 < float(began) < 3.2 and 7.0 < float(ended) < 10.0  # half a second before the human, who begins at 3.0 s


def test_a_program_in_c_gets_as_many_samples_as_it_gave(stereo, tmp_path):
    compiler = shutil.which("cc") or shutil.which("tcc")
    subprocess.run([compiler, "-Wall", "-o", tmp_path / "pipe", EXAMPLES / "pipe.c"], check=True)
    words = f"'{sys.executable}' -m edgefilter.cli run --input - --output - --quiet --no-learn --engine linear"
    given = stereo[: 6 * RATE]
    done = subprocess.run(
        [tmp_path / "pipe", words], input=given.astype("<i2").tobytes(), capture_output=True, cwd=ROOT, timeout=300
    )
    assert done.returncode == 0, done.stderr.decode()
    human = np.frombuffer(done.stdout, "<i2") / 32768
    assert human.size == len(given)
    assert db(human[4 * RATE : 5 * RATE]) < db(given[4 * RATE : 5 * RATE, 0] / 32768) - 8  # uncalibrated, after 4 s
    failed = subprocess.run([tmp_path / "pipe", "exit 3"], input=b"", capture_output=True)
    assert failed.returncode == 3


def test_the_simulated_room_holds_the_robot_and_then_the_human(tmp_path):
    said, _ = run("room.py", tmp_path / "heard.wav")
    assert b"9.0 s heard" in said
    heard = read(tmp_path / "heard.wav")
    assert db(heard[RATE : 2 * RATE]) > db(heard[7 * RATE : 8 * RATE]) + 15 > db(heard[: RATE // 10]) + 15
    said, _ = run("words.py", tmp_path / "heard.wav")
    assert said == b"(9.0 s)\n"


@pytest.mark.parametrize(
    "address", [["ws://127.0.0.1:9"], ["nonsense"], []], ids=["nobody serves", "no address", "none"]
)
def test_the_satellite_without_a_service_says_so_in_one_line(address):
    words = [sys.executable, EXAMPLES / "satellite.py", *address]
    done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and done.stderr.startswith("satellite.py: "), (
        done.stderr
    )
