"""A private PulseAudio server with null sinks or piped sources, seen by PortAudio through ALSA by their and their monitors' names."""

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


def start_server(folder: Path, sinks: Sequence[str] = SINKS, sources: Sequence[str] = ()) -> Server:
    """Start a server whose files all lie in folder and wait until its devices are there.

    The first sink is the default output, the last one's monitor the default microphone. sources: microphones that hear
    what is written into folder/NAME, 16-bit at 16 kHz, when it is written; a sink has a clock of its own, which stands
    still and jumps where programs come and go.
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
    for name in sources:
        (folder / name).unlink(missing_ok=True)
        modules += [f"module-pipe-source source_name={name} file={folder / name} rate=16000 format=s16le channels=1"]
    for module in modules:
        arguments += ["-L", module]
    with open(folder / "log", "w") as log:
        process = subprocess.Popen(["pulseaudio", *arguments], env=environment, stdout=log, stderr=log)
    environment |= {"PULSE_SERVER": socket, "ALSA_CONFIG_PATH": str(folder / "asound.conf"), "OMP_NUM_THREADS": "1"}
    names = {**{name: name for name in (*sinks, *sources)}, **{f"{name}_monitor": f"{name}.monitor" for name in sinks}}
    entries = [f'pcm.{pcm} {{ type pulse\n server "{socket}"\n device "{device}" }}\n' for pcm, device in names.items()]
    usual = [f'pcm.{pcm} {{ type pulse\n server "{socket}" }}\n' for pcm in ("!default", "pulse")]
    (folder / "asound.conf").write_text("</usr/share/alsa/alsa.conf>\n" + "".join(entries + usual))
    for _ in range(300):
        listed = subprocess.run(["pactl", "list", "short"], env=environment, capture_output=True, text=True)
        if all(f"\t{name}\t" in listed.stdout for name in (*sinks, *sources)):
            if sinks:
                subprocess.run(["pactl", "set-default-sink", sinks[0]], env=environment, check=True)
                subprocess.run(["pactl", "set-default-source", f"{sinks[-1]}.monitor"], env=environment, check=True)
            return Server(process, environment, "".join(entries))
        if process.poll() is not None:
            break
        time.sleep(0.1)
    process.kill()
    raise RuntimeError("pulseaudio did not start:\n" + (folder / "log").read_text())


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


def memory_mb(pid: int | str = "self") -> float:
    """Resident memory of a process now, MB (Linux); 0 where it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 2**20
    except (FileNotFoundError, ProcessLookupError):
        return 0.0


def children_mb(pid: int) -> float:
    """The same of all processes that it started, and that these started: of a running filter, the learner's."""
    try:
        listed = [path.read_text().split() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    children = [int(child) for some in listed for child in some]
    return sum(memory_mb(child) + children_mb(child) for child in children)
