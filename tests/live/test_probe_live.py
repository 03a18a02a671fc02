"""`edgefilter probe --live` on real streams: a virtual loudspeaker that was turned down, and a sound server that ends."""

import json
import subprocess

import numpy as np
import pytest
import soundfile

from edgefilter.echo.model import EchoModel
from edgefilter.types import PRE_ROLL, SAMPLE_RATE
from tests.diagnosis.robot_scene import profile, record, voice
from tests.program import ROOT, argv

pytestmark = pytest.mark.slow


@pytest.fixture
def robot(tmp_path):
    """A folder with a robot whose path is a gain of one, and a recording of it 1 dB down."""
    x, turned = voice(5.0), {"gain_db": -1.0}
    straight = np.eye(1, 6400, PRE_ROLL, dtype=np.float32)[0]
    profile(straight).save(tmp_path / "robot.npz")
    soundfile.write(tmp_path / "ref.wav", x, SAMPLE_RATE, "FLOAT")
    y = record(x, EchoModel(straight).with_effect("playback_gain", turned))
    soundfile.write(tmp_path / "mic.wav", y, SAMPLE_RATE, "FLOAT")
    return tmp_path


def probing(server, folder, *more):
    files = ("--profile", folder / "robot.npz", "--recording", folder / "mic.wav", "--reference", folder / "ref.wav")
    command = argv("probe", "playback_gain", "chassis_resonance", *files, "--live", "--speaker", "robot", *more)
    return subprocess.Popen(
        command, env=server.environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_a_loudspeaker_that_was_turned_down_is_told_from_one_whose_case_rings(server, robot):
    """A sink that is heard itself, so that its clock is one, 1 dB down."""
    subprocess.run(["pactl", "set-sink-volume", "robot", "-1dB"], env=server.environment, check=True)
    probe = probing(server, robot, "--input", "robot_monitor", "--json", robot / "said.json")
    said, notes = probe.communicate(timeout=120)
    assert probe.returncode == 0, (said, notes)
    found = json.loads((robot / "said.json").read_text())
    assert found["settled"] and found["explanations"][0]["effects"] == ["playback_gain"], (said, notes)
    assert "it is       playback_gain" in said and notes.count("now playing") == len(found["sounds"]) <= 2


def test_a_sound_server_that_ends_while_it_plays_is_one_line(server, robot):
    probe = probing(server, robot, "--input", "robot_monitor")
    for line in probe.stderr:
        if "now playing" in line:
            break
    server.process.kill()
    _, notes = probe.communicate(timeout=60)
    lines = [line for line in notes.splitlines() if line.startswith("edgefilter: ")]
    assert probe.returncode == 1 and len(lines) == 1 and "Traceback" not in notes, notes
