"""`edgefilter run --input mic` as on a laptop: default microphone, reference from the default output's monitor, Ctrl-C."""

import json
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import soundfile
import soxr

from edgefilter import Profile
from edgefilter.session import level_db as db
from tests.learning.scenes import Scene
from tests.program import DEMO, ROOT, argv

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def conversation(tmp_path_factory):
    """The first 7 s of the bundled conversation as 16-bit WAV for the players."""
    folder = tmp_path_factory.mktemp("conversation")
    for sink, name in (("robot", "reference"), ("robot_mic", "mic")):
        soundfile.write(
            folder / f"{sink}.wav",
            soundfile.read(DEMO / f"{name}.flac", dtype="int16")[0][: 7 * 16000],
            16000,
            "PCM_16",
        )
    return folder


def play(server, folder):
    return [
        subprocess.Popen(["paplay", "-d", sink, str(folder / f"{sink}.wav")], env=server.environment)
        for sink in ("robot", "robot_mic")
    ]


def run_until_played(server, command, folder, heard):
    """Start a live run, play the folder's sounds once the first samples are on disk at heard, end it by Ctrl-C; what it said."""
    live = subprocess.Popen(command, env=server.environment, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    for _ in range(300):
        if heard.exists() and heard.stat().st_size > 10_000:
            break
        time.sleep(0.1)
    return play_and_end(live, server, folder)[1]


def play_and_end(live, server, folder):
    """Play the folder's sounds to a live run and end it by Ctrl-C; what it wrote to standard output and error."""
    for player in play(server, folder):
        assert player.wait(timeout=60) == 0
    time.sleep(1.5)
    live.send_signal(signal.SIGINT)
    written, said = live.communicate(timeout=60)
    assert live.returncode == 0 and "Traceback" not in said, said
    return written, said


def test_live_run_takes_the_monitor_ends_by_ctrl_c_and_equals_the_file_path(server, conversation, tmp_path):
    command = argv(
        "run", "--input", "mic", "--profile", DEMO / "profile.npz", "--output", tmp_path / "live.wav", "--engine", "ss",
        "--record", tmp_path / "heard", "--json", tmp_path / "stats.json", "--no-learn",
    )  # fmt: skip
    heard = tmp_path / "heard/mic.wav"
    said = run_until_played(server, command, conversation, heard)
    assert "robot.monitor" in said

    stats = json.loads((tmp_path / "stats.json").read_text())
    out, mic, ref = (
        soundfile.read(path, dtype="float32")[0]
        for path in (tmp_path / "live.wav", heard, tmp_path / "heard/reference.wav")
    )
    assert stats["samples_in"] == stats["samples_out"] == out.size == mic.size == ref.size
    assert db(mic) > -60 and db(ref) > -60
    again = argv(
        "run", "--input", heard, "--reference", tmp_path / "heard/reference.wav", "--profile", DEMO / "profile.npz",
        "--output", tmp_path / "file.wav", "--engine", "ss", "--no-learn",
    )  # fmt: skip
    subprocess.run(again, cwd=ROOT, check=True, capture_output=True)
    assert (tmp_path / "file.wav").read_bytes() == (tmp_path / "live.wav").read_bytes()

    first = int(np.argmax(np.abs(mic) > 0.02))
    speech = slice(first + 16_000, first + 5 * 16_000)
    assert (
        db(out[speech]) < db(mic[speech]) - 15
    )  # 25 dB were seen; the players start the two channels at different times


def test_live_the_loudspeaker_is_learned_by_another_process_and_remembered(server, tmp_path):
    scene = Scene(seconds=10.0)
    for sink, sound in (("robot", scene.reference), ("robot_mic", scene.mic)):
        soundfile.write(tmp_path / f"{sink}.wav", sound, 16_000, "PCM_16")
    file = tmp_path / "robot.npz"
    command = argv(
        "run", "--input", "mic", "--output", tmp_path / "live.wav", "--engine", "linear", "--learn", file,
        "--json", tmp_path / "stats.json", "--record", tmp_path / "heard",
    )  # fmt: skip
    run_until_played(server, command, tmp_path, tmp_path / "heard/mic.wav")
    learning = json.loads((tmp_path / "stats.json").read_text())["learning"]
    assert learning["process"] == "running" and learning["heard_s"] > 2 and learning["rounds"] > 0
    assert Profile.load(file).learned


def test_live_the_clocks_of_microphone_and_reference_may_differ(server, tmp_path):
    """The microphone's sound is played faster by 300 ppm than the reference's, as a clock that is slower hears it."""
    scene = Scene(seconds=12.0)
    for sink, sound in (("robot", scene.reference), ("robot_mic", soxr.resample(scene.mic, 1e6 + 300, 1e6))):
        soundfile.write(tmp_path / f"{sink}.wav", sound, 16_000, "PCM_16")
    command = argv(
        "run", "--input", "mic", "--output", tmp_path / "live.wav", "--engine", "linear", "--no-learn",
        "--json", tmp_path / "stats.json", "--record", tmp_path / "heard",
    )  # fmt: skip
    run_until_played(server, command, tmp_path, tmp_path / "heard/mic.wav")
    found = json.loads((tmp_path / "stats.json").read_text())["alignment"]
    assert 150 < abs(found["ppm"]) < 450, found
    mic, out = (
        soundfile.read(path, dtype="float32")[0] for path in (tmp_path / "heard/mic.wav", tmp_path / "live.wav")
    )
    first = int(np.argmax(np.abs(mic) > 0.02))
    late = slice(first + 7 * 16_000, first + 11 * 16_000)
    assert db(out[late]) < db(mic[late]) - 8


def run_for(server, seconds, tmp_path, *more):
    """A live run of so many seconds without a profile, its words and its figures."""
    command = argv(
        *"run --input mic --output".split(),
        tmp_path / "live.wav",
        "--json",
        tmp_path / "stats.json",
        "--seconds",
        seconds,
        *more,
    )
    result = subprocess.run(command, env=server.environment, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    stats = json.loads((tmp_path / "stats.json").read_text())
    assert (
        stats["samples_in"]
        == stats["samples_out"]
        == soundfile.info(tmp_path / "live.wav").frames
        == round(seconds * 16_000)
    )
    return result.stderr, stats


def test_live_an_engine_over_its_budget_is_left_and_every_sample_is_there(server, tmp_path):
    """No machine runs a hop in 1 us, so that both engines of the fallback are over the budget."""
    said, stats = run_for(server, 3, tmp_path, "--engine", "ss", "--budget-ms", "0.001")
    assert "stepped down from ss to linear" in said and "overloaded" in said
    kinds = [event["kind"] for event in stats["events"]]
    assert [kind for kind in kinds if kind not in ("lost", "overrun")] == ["stepped_down", "overloaded"]
    assert stats["engines"] == ["ss", "linear"] and stats["engine"] == "linear"
    assert stats["deadline"]["over_budget"] == stats["deadline"]["hops"] and "deadlines missed" in said


def test_live_auto_measures_the_engines_and_says_why(server, tmp_path):
    said, stats = run_for(server, 1, tmp_path, "--budget-ms", "1000")
    choice = stats["choice"]
    assert (
        stats["engines"][0] == choice["engine"]
        and choice["reason"] == stats["engine_reason"]
        and choice["reason"] in said
    )
    assert choice["figures"][0]["hops"] > 0 and "1000 ms" in choice["reason"] and "p99" in choice["reason"]


def test_an_unknown_device_is_one_line_that_names_the_known_ones(server, tmp_path):
    result = subprocess.run(
        argv("run", "--input", "nosuchmic", "--output", tmp_path / "x.wav"),
        env=server.environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    lines = [line for line in result.stderr.splitlines() if line.startswith("edgefilter:")]
    assert result.returncode == 2 and len(lines) == 1, result.stderr
    assert "nosuchmic" in lines[0] and "'robot_mic.monitor'" in lines[0] and "'pulse'" not in lines[0]


def test_devices_lists_them_and_the_reference(server):
    result = subprocess.run(argv("devices"), env=server.environment, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "sound server, output  robot_mic" in result.stdout
    assert "robot_mic_monitor" in result.stdout and "take its reference from: robot.monitor" in result.stdout


def doctor(server, *words):
    """What the doctor found, by the name of the check, and its exit code."""
    command = argv("doctor", "--json", "-", *words)
    result = subprocess.run(command, env=server.environment, cwd=ROOT, capture_output=True, text=True)
    found = json.loads(result.stdout)
    assert found["fit"] == (result.returncode == 0), result.stderr
    return {check["name"]: check for check in found["checks"]}, result


def test_the_doctor_finds_the_virtual_machine_fit(server):
    checks, result = doctor(server)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "as shipped" in checks["model"]["found"] and "robot.monitor" in checks["reference"]["found"]
    assert {"microphone", "mic clock", "ref clock", "sound server"} <= set(checks)
    assert checks["level"]["state"] == "warning" and "unmute" in checks["level"]["do"]  # nobody plays anything
    assert "peak -18 dB of full scale (--no-chirp" in result.stderr
    assert "the microphone does not hear them" in checks["set-up"]["found"]
    quiet, result = doctor(server, "--no-chirp")
    assert "set-up" not in quiet and "chirps" not in result.stderr


def test_the_doctor_hears_the_robot_by_the_way_that_run_takes(loopback):
    checks, _ = doctor(loopback)
    told = re.match(r"the microphone hears the robot after (\d+) ms, \d+ dB above the noise", checks["set-up"]["found"])
    assert checks["set-up"]["state"] != "failed" and 0 < int(told[1]) < 500, checks["set-up"]


def test_the_doctor_says_that_the_microphone_is_the_monitor_and_that_the_reference_is_the_wrong_one(loopback):
    copied, result = doctor(loopback, "--input", "robot.monitor")
    assert result.returncode == 1 and "microphone and reference are both 'robot.monitor'" in copied["set-up"]["found"]
    words = "module-null-sink sink_name=other rate=16000 channels=1".split()
    subprocess.run(["pactl", "load-module", *words], env=loopback.environment, check=True)
    silent, result = doctor(loopback, "--reference", "other.monitor")
    assert result.returncode == 1 and "'other.monitor' is silent while something is played" in silent["set-up"]["found"]


def test_the_example_that_listens_says_when_somebody_spoke_while_it_runs(server, tmp_path):
    cut = [soundfile.read(DEMO / f"{name}.flac", dtype="int16")[0][6 * 16000 :] for name in ("reference", "mic")]
    for sink, samples in zip(("robot", "robot_mic"), cut):
        soundfile.write(tmp_path / f"{sink}.wav", samples, 16000, "PCM_16")
    log = tmp_path / "events.jsonl"
    command = argv("run", "--input", "mic", "--profile", DEMO / "profile.npz", "--output", "-", "--engine", "crnn",
                         "--no-learn", "--quiet", "--log-json", log)  # fmt: skip
    with subprocess.Popen(
        command, env=server.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell has its background jobs ignore it
    ) as live:  # fmt: skip
        listener = subprocess.Popen(
            [sys.executable, ROOT / "docs/examples/listen.py", log],
            stdin=live.stdout,
            stdout=subprocess.PIPE,
            text=True,
        )
        until = time.monotonic() + 60
        while not log.exists() or not log.read_text():
            assert time.monotonic() < until, live.stderr.read()
            time.sleep(0.1)
        for player in play(server, tmp_path):
            assert player.wait(timeout=60) == 0
        time.sleep(1.5)
        live.send_signal(signal.SIGINT)
        said = listener.communicate(timeout=60)[0]
    assert re.search(r"^\S+ (to|s to) \S+.*: \(\S+ s\)$", said, re.MULTILINE), said  # somebody spoke
