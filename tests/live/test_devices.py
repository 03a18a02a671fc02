"""Live audio through the real PortAudio, over virtual devices."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
import soxr

from tests.filter.array_scene import calibration
from tests.program import ROOT, argv

pytestmark = pytest.mark.slow

SESSION = Path(__file__).with_name("session.py")
QUIET = 8000  # samples of silence first: a sound server swallows the first milliseconds of a stream


@pytest.fixture
def sounds(tmp_path):
    """Two different noises in 16 bit, (n,) float32 as their players play them."""
    random = np.random.default_rng(7)
    made = {}
    for name in ("robot", "robot_mic"):
        noise = soxr.resample(random.uniform(-9000, 9000, 9000), 6000, 16000)  # with room for an interpolation
        pcm = np.concatenate((np.zeros(QUIET), noise)).astype(np.int16)
        soundfile.write(tmp_path / f"{name}.wav", pcm, 16000, subtype="PCM_16")
        made[name] = pcm / np.float32(32768)
    return made


def run(job, server, folder, *more):
    done = subprocess.run(
        [sys.executable, str(SESSION), job, str(folder), *more],
        env=server.environment | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    results = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    assert len(results) == 1, done.stderr
    return json.loads(results[0].removeprefix("RESULT "))


def offset_of(sound, heard):
    """Where the noisy part of sound begins in heard, in samples."""
    probe = sound[QUIET : QUIET + 4000]
    return int(np.argmax(np.correlate(heard, probe, "valid"))) - QUIET


def assert_contained(sound, heard, server):
    """Exact with PulseAudio: 16-bit samples at the devices' own rate pass through every stage unchanged.

    PipeWire's graph runs at 48 kHz: the same samples, interpolated at a place of its own between them.
    """
    at = offset_of(sound, heard)
    got, sent = heard[at + QUIET : at + sound.size], sound[QUIET:]
    if server.system == "pulseaudio":
        np.testing.assert_array_equal(got, sent)
    else:
        assert np.corrcoef(got, sent)[0, 1] > 0.9  # half a sample of 3 kHz noise off: 0.94


def test_both_channels_arrive_sample_for_sample_and_nothing_is_lost(server, tmp_path, sounds):
    result = run("receive", server, tmp_path)
    heard = np.load(tmp_path / "received.npz")
    assert heard["mic"].size == heard["ref"].size == 4 * 16000
    assert result["gapless"] and not any(result["stats"].values()), result
    assert_contained(sounds["robot_mic"], heard["mic"], server)
    assert_contained(sounds["robot"], heard["ref"], server)
    assert "reference: robot_monitor" in result["notes"]


def test_sink_plays_everything_after_the_latency(server, tmp_path, sounds):
    result = run("sink", server, tmp_path)
    assert result["sink"] == {"written": sounds["robot"].size, "clipped": 0, "underruns": 0, "missing": 0, "dropped": 0}
    assert_contained(sounds["robot"], np.load(tmp_path / "received.npz")["mic"], server)


def test_play_and_record_hears_the_whole_sound_and_never_before_it_is_played(server, tmp_path, sounds):
    run("measure", server, tmp_path)
    heard = np.load(tmp_path / "received.npz")["mic"]
    assert heard.size == sounds["robot"].size + 16000
    assert 0 <= offset_of(sounds["robot"], heard) < 16000  # the tail holds a second of delay
    assert_contained(sounds["robot"], heard, server)


def test_a_server_that_dies_is_one_error_after_what_was_received(server, tmp_path):
    result = run("vanish", server, tmp_path, str(server.process.pid))
    assert result["error"] == "DeviceError" and result["samples"] > 8000
    assert "stopped" in result["text"] and "\n" not in result["text"]


def test_stop_from_a_signal_handler_ends_with_equal_lengths(server, tmp_path):
    result = run("stop", server, tmp_path)
    assert result["mic"] == result["ref"] > 0


def test_devices_are_listed_and_the_monitor_is_found(server, tmp_path):
    result = run("devices", server, tmp_path)
    assert {"robot", "robot_mic", "robot_monitor", "robot_mic_monitor"} <= {d["name"] for d in result["devices"]}
    assert result["monitor"] == "robot_mic_monitor"


@pytest.mark.parametrize("microphones", [2, 1])
def test_all_channels_of_the_microphone_are_opened_where_the_profile_is_of_an_array(new_server, tmp_path, microphones):
    server = new_server(channels=2)
    calibration(microphones).save(tmp_path / "robot.npz")
    asked = ["run", "--input", "mic", "--profile", tmp_path / "robot.npz", "--engine", "linear", "--no-learn"]
    asked += ["--seconds", "2", "--output", tmp_path / "out.wav", "--json", tmp_path / "run.json", "--quiet"]
    done = subprocess.run(
        argv(*asked),
        env=server.environment, cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    array = json.loads((tmp_path / "run.json").read_text())["array"]
    if microphones == 2:
        assert array["microphones"] == 2 and "all 2 channels are microphones" in done.stderr
    else:
        assert array is None and "the microphone has 2 channels and is one" in done.stderr
