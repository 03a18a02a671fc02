"""A private PulseAudio or PipeWire server with null sinks. PortAudio sees each sink and its monitor through ALSA, under their names."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

SINKS = ("robot", "robot_mic")
SYSTEMS = ("pulseaudio", "pipewire")


@dataclass
class Server:
    """A running sound server: its processes, and the environment variables with which programs reach it."""

    process: subprocess.Popen
    environment: dict
    system: str = "pulseaudio"
    others: list[subprocess.Popen] = field(default_factory=list)

    def stop(self) -> None:
        for process in (self.process, *self.others):
            process.kill()
            process.wait()


def start_server(folder: Path, sinks: Sequence[str] = SINKS, system: str = SYSTEMS[0], channels: int = 1) -> Server:
    """Start a sound server that keeps all its files in folder, and wait until its devices are there.

    The first sink is the default output, the last one's monitor the default microphone. channels: of each sink.
    """
    pulse = system == "pulseaudio"
    socket = f"unix:{folder}/{'socket' if pulse else 'pulse/native'}"
    environment = {**os.environ, "HOME": str(folder), "XDG_RUNTIME_DIR": str(folder)}
    environment |= {"PULSE_RUNTIME_PATH": str(folder / "pulse"), "DBUS_SESSION_BUS_ADDRESS": f"unix:path={folder}/bus"}
    modules = [f"module-null-sink sink_name={name} rate=16000 format=s16le channels={channels}" for name in sinks]
    start = _start_pulseaudio if pulse else _start_pipewire
    process, *others = start(folder, environment, modules)
    environment |= {"PULSE_SERVER": socket, "ALSA_CONFIG_PATH": str(folder / "asound.conf"), "OMP_NUM_THREADS": "1"}
    if not pulse:
        _load(modules, environment, process)
    names = {name: name for name in sinks} | {f"{name}_monitor": f"{name}.monitor" for name in sinks}
    entries = [f'pcm.{pcm} {{ type pulse\n server "{socket}"\n device "{device}" }}\n' for pcm, device in names.items()]
    usual = [f'pcm.{pcm} {{ type pulse\n server "{socket}" }}\n' for pcm in ("!default", "pulse")]
    (folder / "asound.conf").write_text("</usr/share/alsa/alsa.conf>\n" + "".join(entries + usual))
    for _ in range(300):
        listed = subprocess.run(["pactl", "list", "short"], env=environment, capture_output=True, text=True)
        if all(f"\t{name}\t" in listed.stdout for name in sinks):
            subprocess.run(["pactl", "set-default-sink", sinks[0]], env=environment, check=True)
            subprocess.run(["pactl", "set-default-source", f"{sinks[-1]}.monitor"], env=environment, check=True)
            return Server(process, environment, system, others)
        if process.poll() is not None:
            break
        time.sleep(0.1)
    Server(process, environment, system, others).stop()
    raise RuntimeError(f"{system} did not start:\n" + (folder / "log").read_text())


def _start_pulseaudio(folder: Path, environment: dict, modules: Sequence[str]) -> list[subprocess.Popen]:
    arguments = ["-n", "--daemonize=no", "--use-pid-file=no", "--exit-idle-time=-1", "--disable-shm=yes"]
    for module in (f"module-native-protocol-unix socket={folder}/socket auth-anonymous=1", *modules):
        arguments += ["-L", module]
    with open(folder / "log", "w") as log:
        return [subprocess.Popen(["pulseaudio", *arguments], env=environment, stdout=log, stderr=log)]


def _start_pipewire(folder: Path, environment: dict, modules: Sequence[str]) -> list[subprocess.Popen]:
    """PipeWire, its session manager, what speaks PulseAudio's protocol, and the bus that they meet on."""
    (folder / "bus").unlink(missing_ok=True)
    bus_daemon = ["dbus-daemon", "--session", "--nofork", f"--address=unix:path={folder}/bus"]
    programs = ((bus_daemon, "bus"), (["pipewire"], "pipewire-0"), (["wireplumber"], ""), (["pipewire-pulse"], ""))
    started = []
    with open(folder / "log", "w") as log:
        for program, socket in programs:
            started.append(subprocess.Popen(program, env=environment, stdout=log, stderr=log))
            for _ in range(100):
                if not socket or (folder / socket).exists():
                    break
                time.sleep(0.05)
    bus, pipewire, *others = started
    return [pipewire, *others, bus]


def _load(modules: Sequence[str], environment: dict, process: subprocess.Popen) -> None:
    """Load the modules, again until the session manager takes them."""
    for module in modules:
        for _ in range(100):
            words = ["pactl", "load-module", *module.split()]
            if process.poll() is not None or not subprocess.run(words, env=environment, capture_output=True).returncode:
                break
            time.sleep(0.1)


@contextmanager
def server(sinks: Sequence[str] = SINKS, system: str = "pulseaudio", channels: int = 1) -> Iterator[Server]:
    """A server of one's own for a while. Its folder is short: socket paths hold 107 bytes."""
    with tempfile.TemporaryDirectory(prefix="pulse", ignore_cleanup_errors=True) as folder:
        started = start_server(Path(folder), sinks, system=system, channels=channels)
        try:
            yield started
        finally:
            started.stop()


def memory_mb(pid: int | str = "self") -> float:
    """Resident memory of a process now, MB (Linux); 0 where it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 2**20
    except (FileNotFoundError, ProcessLookupError):
        return 0.0


def processor_s(pid: int) -> float:
    """Seconds of processor that a process has taken (Linux); 0 where it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def children(pid: int) -> list[int]:
    """The process numbers of all descendants; those of a running filter are its learner's processes."""
    try:
        listed = [path.read_text().split() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    except (FileNotFoundError, ProcessLookupError):
        return []
    own = [int(child) for some in listed for child in some]
    return own + [one for child in own for one in children(child)]
