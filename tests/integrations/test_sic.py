"""Against the real Social Interaction Cloud: its Redis server, component managers, connectors and messages."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from edgefilter.dsp.metrics import si_sdr

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).with_name("sic_program.py")
RATE = 16_000


class Cloud:
    """A Redis server, and the component of edgefilter beside it; each can be ended and started again."""

    def __init__(self, folder):
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        own = {"DB_IP": "127.0.0.1", "DB_PORT": str(self.port), "DB_PASS": "secret", "SIC_IP": "127.0.0.1"}
        self.environment = {**os.environ, **own, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
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

    def component(self):
        with open(self.folder / "component.log", "a") as log:
            words = ("-m", "edgefilter.integrations.sic", "--profile", str(ROOT / "edgefilter/demo_data/profile.npz"))
            started = self.start(sys.executable, *words, stdout=log, stderr=log)
        for _ in range(400):
            if "HumanComponent" in (self.folder / "component.log").read_text():
                return started
            time.sleep(0.05)
        raise RuntimeError((self.folder / "component.log").read_text())

    def run_program(self):
        done = subprocess.run(
            [sys.executable, PROGRAM, self.folder], env=self.environment, cwd=self.folder, capture_output=True, text=True, timeout=120
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
    first = cloud.component()
    sound, told = cloud.run_program()
    check(sound, told, room_of)
    first.kill()
    first.wait()
    (cloud.folder / "component.log").unlink()
    (cloud.folder / "told.json").unlink()
    cloud.component()
    check(*cloud.run_program(), room_of)


def check(sound, told, room_of):
    """The room's human begins after 3 s, 23 dB below the robot, who talks until 5.7 s."""
    assert sound.size > 5.5 * RATE
    (began,) = (seconds for kind, seconds, speaks in told if speaks)
    assert 3.0 < began < 3.6, told
    both = slice(3 * RATE, round(5.4 * RATE))
    human = room_of.HUMAN[: both.stop - both.start]
    assert max(si_sdr(sound[both], np.roll(human, shift)) for shift in (0, 1)) > 3  # before: -23 dB
    assert not [kind for kind, *_ in told if kind.startswith(("reference", "robot", "rate"))]


def test_without_a_server_it_is_one_line(cloud):
    words = ("-m", "edgefilter.integrations.sic", "--engine", "linear")
    done = subprocess.run([sys.executable, *words], env=cloud.environment, capture_output=True, text=True, timeout=100)
    said = done.stderr.splitlines()
    assert done.returncode == 1 and len(said) == 1 and "Redis" in said[0], done.stderr


def test_a_profile_that_is_none_is_one_line(cloud):
    words = ("-m", "edgefilter.integrations.sic", "--profile", str(PROGRAM))
    done = subprocess.run([sys.executable, *words], env=cloud.environment, capture_output=True, text=True, timeout=100)
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1 and "profile" in done.stderr
