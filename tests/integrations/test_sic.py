"""Against the real Social Interaction Cloud: its Redis server, component managers, connectors and messages."""

import json
import os
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edgefilter import Profile
from edgefilter.calibration.calibrate import cross_density
from edgefilter.dsp.metrics import si_sdr
from edgefilter.dsp.resample import Resampler
from edgefilter.integrations import sic
from edgefilter.profile.array import ArrayCalibration
from edgefilter.types import SAMPLE_RATE as RATE
from tests.program import ROOT

PROGRAM = Path(__file__).with_name("sic_program.py")
PROFILE = ROOT / "edgefilter/demo_data/profile.npz"


class Cloud:
    """A Redis server, and the component of edgefilter beside it; each can be ended and started again."""

    def __init__(self, folder):
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        own = {"DB_IP": "127.0.0.1", "DB_PORT": str(self.port), "DB_PASS": "secret", "SIC_IP": "127.0.0.1"}
        self.environment = {**os.environ, **own, "PYTHONPATH": f"{folder}:{ROOT}", "OMP_NUM_THREADS": "1"}
        # the room's time is not the machine's: a slow machine is no microphone that was off
        patient = "from edgefilter.integrations import duplex\nduplex.WAITED_S = 1e9\n"
        (folder / "sitecustomize.py").write_text(patient)
        self.processes = []

    def start(self, *words, **more):
        process = subprocess.Popen(words, env=self.environment, cwd=self.folder, **more)
        self.processes.append(process)
        return process

    def redis(self):
        words = ("--port", str(self.port), "--requirepass", "secret", "--save", "", "--bind", "127.0.0.1")
        server = self.start("redis-server", *words, stdout=subprocess.DEVNULL)
        for _ in range(100):
            with socket.socket() as knock:
                if knock.connect_ex(("127.0.0.1", self.port)) == 0:
                    return server
            time.sleep(0.05)
        raise RuntimeError("redis-server did not start")

    def component(self, profile=PROFILE, *words):
        with open(self.folder / "component.log", "a") as log:
            words = ("-m", "edgefilter.integrations.sic", "--profile", str(profile), *words)
            started = self.start(sys.executable, *words, stdout=log, stderr=log)
        for _ in range(400):
            if "HumanComponent" in (self.folder / "component.log").read_text():
                return started
            time.sleep(0.05)
        raise RuntimeError((self.folder / "component.log").read_text())

    def stop(self, component):
        """Kill it, as a crash does; the next one writes another log."""
        component.kill()
        component.wait()
        for name in ("component.log", "told.json"):
            (self.folder / name).unlink()

    def run_program(self, *words):
        done = subprocess.run(
            [sys.executable, PROGRAM, self.folder, *words], env=self.environment, cwd=self.folder, capture_output=True, text=True, timeout=120
        )  # fmt: skip
        told = self.folder / "told.json"
        assert told.exists(), done.stdout[-2000:] + done.stderr[-2000:]
        return np.load(self.folder / "human.npy") / 32768, json.loads(told.read_text())

    def end(self):
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cloud(tmp_path):
    cloud = Cloud(tmp_path)
    yield cloud
    cloud.end()


@pytest.mark.slow
def test_a_program_gets_the_human_and_is_told_when_he_interrupts_also_after_the_component_died(cloud, room_of):
    cloud.redis()
    for _ in range(2):
        component = cloud.component()
        check(*cloud.run_program(), room_of)
        cloud.stop(component)


@pytest.mark.slow
def test_the_four_microphones_of_a_robot_s_head_are_one_array(cloud, room_of):
    robot, rng = Profile.load(PROFILE), np.random.default_rng(6)
    fan = np.tile(room_of.Room().fan, 20)
    heard = np.stack([np.roll(fan, 3 * at) for at in range(4)]) + 0.1 * np.std(fan) * rng.standard_normal((4, fan.size))
    further = np.stack([np.roll(robot.echo.impulse_response, 3 * at) for at in range(1, 4)])
    four = replace(robot, array=ArrayCalibration(further, cross_density(heard.astype(np.float32))))
    four.save(cloud.folder / "four.npz")
    cloud.redis()
    cloud.component(cloud.folder / "four.npz", "--channels", "4")
    sound, told = cloud.run_program("four")
    check(Resampler(48_000, RATE).push(sound.astype(np.float32), last=True), told, room_of)


def check(sound, told, room_of):
    """The room's human begins after 3 s, 23 dB below the robot, who talks until 5.7 s."""
    assert sound.size > 5.5 * RATE
    (began,) = (seconds for _, seconds, speaks, _ in told if speaks)
    assert 3.0 < began < 3.6, told
    both = slice(3 * RATE, round(5.4 * RATE))
    human = room_of.HUMAN[: both.stop - both.start]
    assert max(si_sdr(sound[both], np.roll(human, shift)) for shift in (0, 1)) > 3  # before: -23 dB
    kinds = [kind for kind, *_ in told]
    assert kinds.count("realigned") == 1 and not [k for k in kinds if k.startswith(("reference", "robot", "rate"))]


@pytest.mark.slow
def test_without_a_server_it_is_one_line(cloud):
    words = ("-m", "edgefilter.integrations.sic", "--engine", "linear")
    done = subprocess.run([sys.executable, *words], env=cloud.environment, capture_output=True, text=True, timeout=100)
    said = done.stderr.splitlines()
    assert done.returncode == 1 and len(said) == 1 and "Redis" in said[0], done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--profile", str(PROGRAM)], "profile"),
        (["--engine", "linear", "--channels", "4", "--mic-channels", "1,2,4"], "4 channels, 0 to 3, found channel 4"),
        (["--engine", "linear", "--channels", "0"], "channels is 0, expected at least 1"),
    ],
)
def test_what_cannot_be_a_component_is_one_line(words, said, monkeypatch, capsys):
    monkeypatch.setattr(sic, "_default", dict(sic._default))
    assert sic.main(words) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and said in told
