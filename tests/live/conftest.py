"""A private PulseAudio server with two null sinks, seen by PortAudio through ALSA by the names robot, robot_mic and their monitors."""

import os
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

SINKS = ("robot", "robot_mic")


@dataclass
class Server:
    process: subprocess.Popen
    environment: dict

    def stop(self):
        self.process.kill()
        self.process.wait()


def start_server(folder: Path) -> Server:
    """Start a server whose files all lie in folder and wait until its sinks are there."""
    socket = f"unix:{folder}/socket"
    environment = {**os.environ, "HOME": str(folder), "XDG_RUNTIME_DIR": str(folder), "PULSE_RUNTIME_PATH": str(folder / "run")}
    arguments = ["-n", "--daemonize=no", "--use-pid-file=no", "--exit-idle-time=-1", "--disable-shm=yes"]
    modules = [f"module-native-protocol-unix socket={folder}/socket auth-anonymous=1"]
    modules += [f"module-null-sink sink_name={name} rate=16000 format=s16le channels=1" for name in SINKS]
    for module in modules:
        arguments += ["-L", module]
    with open(folder / "log", "w") as log:
        process = subprocess.Popen(["pulseaudio", *arguments], env=environment, stdout=log, stderr=log)
    environment |= {"PULSE_SERVER": socket, "ALSA_CONFIG_PATH": str(folder / "asound.conf"), "OMP_NUM_THREADS": "1"}
    names = {**{name: name for name in SINKS}, **{f"{name}_monitor": f"{name}.monitor" for name in SINKS}}
    entries = [f'pcm.{pcm} {{ type pulse\n server "{socket}"\n device "{device}" }}\n' for pcm, device in names.items()]
    entries += [f'pcm.{pcm} {{ type pulse\n server "{socket}" }}\n' for pcm in ("!default", "pulse")]
    (folder / "asound.conf").write_text("</usr/share/alsa/alsa.conf>\n" + "".join(entries))
    for _ in range(300):
        listed = subprocess.run(["pactl", "list", "short", "sinks"], env=environment, capture_output=True, text=True)
        if all(f"\t{name}\t" in listed.stdout for name in SINKS):
            subprocess.run(["pactl", "set-default-sink", SINKS[0]], env=environment, check=True)
            subprocess.run(["pactl", "set-default-source", f"{SINKS[1]}.monitor"], env=environment, check=True)
            return Server(process, environment)
        if process.poll() is not None:
            break
        time.sleep(0.1)
    process.kill()
    raise RuntimeError("pulseaudio did not start:\n" + (folder / "log").read_text())


@pytest.fixture
def new_server():
    """A function that starts a server of its own; all are ended afterwards. Their folders are short: socket paths hold 107 bytes."""
    started, folders = [], []

    def start():
        folders.append(Path(tempfile.mkdtemp(prefix="pulse")))
        started.append(start_server(folders[-1]))
        return started[-1]

    yield start
    for server in started:
        server.stop()
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def server(new_server):
    return new_server()
