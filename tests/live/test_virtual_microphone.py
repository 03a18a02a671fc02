"""The virtual speaker and microphone: what the robot plays is the reference, and others hear the human."""

import subprocess
import time

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from tests.live.arrived import arrived
from tests.program import DEMO, ROOT, argv

pytestmark = pytest.mark.slow

NAMES = ("edgefilter_speaker", "edgefilter_human", "edgefilter_mic")


def test_others_listen_to_the_virtual_microphone_and_the_robot_plays_into_the_virtual_speaker(
    server, tmp_path, monkeypatch, capsys
):
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)

    def devices(word):
        assert main(["devices", word]) == 0
        return capsys.readouterr().out

    subprocess.run(["sh"], input=devices("--setup"), text=True, check=True, capture_output=True)
    assert "there already" in devices("--load")
    removed, made = devices("--unload"), devices("--load")
    assert all(name in removed and name in made for name in NAMES)

    sounds = {}
    for sink, name in (("edgefilter_speaker", "reference"), ("robot_mic", "human")):
        sound, _ = soundfile.read(DEMO / f"{name}.flac", dtype="float32")
        sound *= 0.5 / np.abs(sound).max()
        begins = int(np.argmax(np.abs(sound) > 0.1))
        sounds[sink] = sound[max(begins - 8000, 0) :][:40_000]
        soundfile.write(tmp_path / f"{sink}.wav", sounds[sink], 16_000, "PCM_16")
    live = subprocess.Popen(
        argv(
            "run", "--input", "mic", "--output", "edgefilter_human", "--engine", "bypass", "--seconds", 5,
            "--record", tmp_path / "heard",
        ),
        cwd=ROOT, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    mic = tmp_path / "heard/mic.wav"
    while live.poll() is None and not (mic.exists() and mic.stat().st_size > 10_000):
        time.sleep(0.05)
    listener = subprocess.Popen(
        ["parec", "-d", "edgefilter_mic", "--rate=16000", "--channels=1", "--format=s16le", "--latency-msec=50", "--raw", tmp_path / "heard.raw"],
    )  # fmt: skip
    players = [subprocess.Popen(["paplay", "-d", sink, tmp_path / f"{sink}.wav"]) for sink in sounds]
    assert [player.wait(timeout=20) for player in players] == [0, 0]
    _, said = live.communicate(timeout=60)
    listener.terminate(), listener.wait()
    heard = np.fromfile(tmp_path / "heard.raw", "<i2").astype(np.float32)
    assert live.returncode == 0 and "reference: edgefilter_speaker.monitor" in said, said
    assert arrived(heard, sounds["robot_mic"][8000:]) > 0.99
    reference, _ = soundfile.read(tmp_path / "heard/reference.wav", dtype="float32")
    assert arrived(reference, sounds["edgefilter_speaker"][8000:]) > 0.99

    subprocess.run(["pactl", "set-default-source", "edgefilter_mic"], check=True)
    for name in ("mic", "filter mic", "edgefilter_human.monitor"):
        done = subprocess.run(
            argv("run", "--input", name, "--output", tmp_path / "x.wav"), cwd=ROOT, capture_output=True, text=True
        )
        assert done.returncode == 2 and "edgefilter's own output" in done.stderr, done.stderr
    devices("--unload")
    assert "nothing to remove" in devices("--unload")
