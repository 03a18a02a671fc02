"""`edgefilter calibrate --live` on real streams: a virtual room is measured, also while another program listens."""

import json
import subprocess
import time

import numpy as np
import pytest
import soundfile

from edgefilter import Profile
from tests.program import ROOT, argv

pytestmark = pytest.mark.slow


def calibrating(server, folder, *arguments):
    files = ("--output", folder / "p.npz", "--json", folder / "p.json")
    return subprocess.Popen(
        argv("calibrate", "--live", *files, *arguments),
        env=server.environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def figures_of(calibration, folder):
    told = calibration.communicate(timeout=180)
    assert calibration.returncode == 0, told
    return json.loads((folder / "p.json").read_text()), told[1].splitlines()


def test_live_calibration_measures_the_virtual_room(server, tmp_path):
    """The default output is looped into the microphone with a gain of one: the path is a delay."""
    subprocess.run(
        ["pactl", "load-module", "module-loopback", "source=robot.monitor", "sink=robot_mic", "latency_msec=30"],
        env=server.environment, check=True, capture_output=True,
    )  # fmt: skip
    asked = "--save-input", tmp_path / "kept", "--while-moving"
    figures, said = figures_of(calibrating(server, tmp_path, *asked), tmp_path)
    assert figures["delay_samples"] > 0
    middle = [band["snr_db"] for band in figures["bands"] if 200 < band["low_hz"] < 5000]
    assert min(middle) > 30  # there is no fan: 16-bit rounding is all the noise
    assert said[:2] == ["now quiet: 5 s of the robot's noise alone", "now playing: 8 s of a sweep"]
    assert "now talking: 16 s of a voice; let the robot move as it does when it talks" in said
    assert len(list((tmp_path / "kept").glob("*.wav"))) == 5
    assert figures["while_moving"]["seconds"] > 5 and figures["while_moving"]["level_db"] < -40  # nothing moves


def test_live_calibration_by_multisines_finds_no_distortion_where_there_is_none(server, tmp_path):
    """On a sink that is heard itself: its clock is one."""
    figures, said = figures_of(
        calibrating(server, tmp_path, "--multisine", "--speaker", "robot", "--input", "robot_monitor"), tmp_path
    )
    assert any("a sweep and multisines" in line for line in said)
    played, left, noise = ([level[f"{key}_db"] for level in figures["levels"]] for key in ("played", "left", "noise"))
    assert np.diff(played) == pytest.approx(6, abs=0.1) and played[-1] == pytest.approx(-16.9, abs=0.5)
    assert max(left) < -60 and max(noise) < -80  # -72 and -100 were seen
    assert len(figures["warnings"]) == 1 and "the noise recording is silent" in figures["warnings"][0]
    profile = Profile.load(tmp_path / "p.npz")
    assert figures["delay_samples"] > 0
    assert profile.approximation is not None and profile.approximation.share < 1e-6  # so the file keeps it, -60 dB
    assert max(figures["distortion_db"].values()) < -60  # -96 were seen


def test_live_calibration_works_while_another_program_listens_to_the_monitor(server, tmp_path):
    """A client that asks for 20 ms has the server ask every client in short steps; at 44.1 kHz buffers of 50 ms ran dry."""
    subprocess.run(
        ["pactl", "load-module", "module-null-sink", "sink_name=loud"],
        env=server.environment, check=True, capture_output=True,
    )  # fmt: skip
    listener = subprocess.Popen(
        ["parec", "-d", "loud.monitor", "--latency-msec=20", "--raw"], env=server.environment, stdout=subprocess.DEVNULL
    )
    try:
        figures, said = figures_of(calibrating(server, tmp_path, "--speaker", "lou", "--input", "loud mon"), tmp_path)
    finally:
        listener.kill()
        listener.wait()
    assert figures["delay_samples"] > 0 and figures["distortion_db"]["2"] < -60
    assert not [line for line in said if "ALSA" in line or "Expression" in line], said


def test_a_sound_server_that_ends_is_one_line_and_what_was_heard_until_then_is_kept(server, tmp_path):
    subprocess.run(
        ["pactl", "load-module", "module-loopback", "source=robot.monitor", "sink=robot_mic", "latency_msec=30"],
        env=server.environment, check=True, capture_output=True,
    )  # fmt: skip
    calibration = calibrating(server, tmp_path, "--save-input", tmp_path / "kept")
    for line in calibration.stderr:
        if "now playing" in line:
            break
    time.sleep(3.0)
    server.process.kill()
    said = calibration.communicate(timeout=60)[1].splitlines()
    assert calibration.returncode == 1 and len(said) == 2, said  # not a word of PortAudio's
    assert said[0] == f"what was recorded is kept in {tmp_path / 'kept'}" and "the sound server ended" in said[1]
    heard = soundfile.read(tmp_path / "kept/sweep_recording.wav")[0]
    assert 1.5 < heard.size / 16000 < 4 and np.abs(heard[-4000:]).max() > 0.1  # into the sweep, which peaks at -12 dB
