"""A private PulseAudio server with null sinks, seen by PortAudio through ALSA by their and their monitors' names."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

SINKS = ("robot", "robot_mic")


@dataclass
class Server:
    """environment: for the processes that are to use it. devices: its lines of ALSA's configuration."""

    process: subprocess.Popen
    environment: dict
    devices: str

    def add(self, other: Server) -> None:
        """Let those who use this server see the other's devices too."""
        with open(self.environment["ALSA_CONFIG_PATH"], "a") as configuration:
            configuration.write(other.devices)

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()


def start_server(folder: Path, sinks: Sequence[str] = SINKS) -> Server:
    """Start a server whose files all lie in folder and wait until its sinks are there.

    The first is the default output, the last the default microphone.
    """
    socket = f"unix:{folder}/socket"
    environment = {
        **os.environ,
        "HOME": str(folder),
        "XDG_RUNTIME_DIR": str(folder),
        "PULSE_RUNTIME_PATH": str(folder / "run"),
    }
    arguments = ["-n", "--daemonize=no", "--use-pid-file=no", "--exit-idle-time=-1", "--disable-shm=yes"]
    modules = [f"module-native-protocol-unix socket={folder}/socket auth-anonymous=1"]
    modules += [f"module-null-sink sink_name={name} rate=16000 format=s16le channels=1" for name in sinks]
    for module in modules:
        arguments += ["-L", module]
    with open(folder / "log", "w") as log:
        process = subprocess.Popen(["pulseaudio", *arguments], env=environment, stdout=log, stderr=log)
    environment |= {"PULSE_SERVER": socket, "ALSA_CONFIG_PATH": str(folder / "asound.conf"), "OMP_NUM_THREADS": "1"}
    names = {**{name: name for name in sinks}, **{f"{name}_monitor": f"{name}.monitor" for name in sinks}}
    entries = [f'pcm.{pcm} {{ type pulse\n server "{socket}"\n device "{device}" }}\n' for pcm, device in names.items()]
    usual = [f'pcm.{pcm} {{ type pulse\n server "{socket}" }}\n' for pcm in ("!default", "pulse")]
    (folder / "asound.conf").write_text("</usr/share/alsa/alsa.conf>\n" + "".join(entries + usual))
    for _ in range(300):
        listed = subprocess.run(["pactl", "list", "short", "sinks"], env=environment, capture_output=True, text=True)
        if all(f"\t{name}\t" in listed.stdout for name in sinks):
            subprocess.run(["pactl", "set-default-sink", sinks[0]], env=environment, check=True)
            subprocess.run(["pactl", "set-default-source", f"{sinks[-1]}.monitor"], env=environment, check=True)
            return Server(process, environment, "".join(entries))
        if process.poll() is not None:
            break
        time.sleep(0.1)
    process.kill()
    raise RuntimeError("pulseaudio did not start:\n" + (folder / "log").read_text())


def listen(server: Server, sink: str, latency_ms: int) -> subprocess.Popen:
    """A program that hears all of a sink, as soon as that, and forgets it; it ends with the server."""
    command = ["parec", "-d", f"{sink}.monitor", f"--latency-msec={latency_ms}", "--raw"]
    listener = subprocess.Popen(command, env=server.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    for _ in range(100):
        listed = subprocess.run(
            ["pactl", "list", "short", "source-outputs"], env=server.environment, capture_output=True, text=True
        )
        if listed.stdout.strip():
            return listener
        time.sleep(0.05)
    listener.kill()
    raise RuntimeError(f"nothing can be heard of {sink}")


@contextmanager
def server(sinks: Sequence[str] = SINKS) -> Iterator[Server]:
    """A server of one's own for a while. Its folder is short: socket paths hold 107 bytes."""
    folder = Path(tempfile.mkdtemp(prefix="pulse"))
    started = None
    try:
        started = start_server(folder, sinks)
        yield started
    finally:
        if started:
            started.stop()
        shutil.rmtree(folder, ignore_errors=True)
