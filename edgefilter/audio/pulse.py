"""What sound devices are called: by PortAudio, and by PulseAudio (and PipeWire), of which PortAudio only sees 'default' or 'pulse'."""

from __future__ import annotations

import os
import re
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeAlias

from edgefilter.errors import DeviceError

STAND_INS = ("pulse", "default", "pipewire")
"""PortAudio's devices that lead to the sound server, the most direct first."""
OPENING = threading.RLock()
"""Held while a stream is opened: what that changes is the whole process's, and two at once would undo each other's."""


@dataclass(frozen=True)
class Device:
    """A sound device as the audio system lists it: number, name, channels each way, its own rate in Hz, its audio system.

    pulse_name: the sound server's own name of it, where PortAudio only has a device that leads to the server.
    """

    index: int
    name: str
    inputs: int
    outputs: int
    rate: float
    system: str = ""
    pulse_name: str = ""

    def __str__(self) -> str:
        return self.name

    def channels(self, kind: str) -> int:
        """Channels in the direction kind, 'input' or 'output'."""
        return self.inputs if kind == "input" else self.outputs


Named: TypeAlias = str | int | Device | None
"""A device as it is asked for: a number, a name or a part of it; None, 'default' and 'mic' are the default one."""


def names(kind: str) -> list[str]:
    """Names of all inputs (kind 'input', monitors included) or outputs of the running server; empty where there is none."""
    lines = _asked("list", "short", "sources" if kind == "input" else "sinks").splitlines()
    return [line.split("\t")[1] for line in lines if "\t" in line]


def channels_of(name: str) -> int:
    """Channels of the input of that name, '' for the default one; 0 where there is none."""
    listed = (line.split("\t") for line in _asked("list", "short", "sources").splitlines())
    name = name or default_name("input")
    found = (re.search(r"\b(\d+)ch\b", line[3]) for line in listed if len(line) > 3 and line[1] == name)
    return next((int(match[1]) for match in found if match), 0)


def default_name(kind: str) -> str:
    """The server's default input or output; '' where there is no server."""
    return _asked("get-default-source" if kind == "input" else "get-default-sink").strip()


def monitor(output: str) -> str | None:
    """Name of the monitor of an output of the server, None where there is no server or no such monitor."""
    name = f"{output}.monitor"
    return name if name in names("input") else None


@contextmanager
def leading_to(name: str, kind: str) -> Iterator[None]:
    """While a stream is opened: let the stand-in lead to this input or output; '' changes nothing.

    PortAudio opens the devices of its list and takes no name of the server's. The environment is all that libpulse
    reads beside that, once, when the stream connects (pulseaudio(1), PULSE_SOURCE and PULSE_SINK); so the variable is
    set for that moment, for one stream at a time.
    """
    if not name:
        yield
        return
    variable = "PULSE_SOURCE" if kind == "input" else "PULSE_SINK"
    with OPENING:
        before = os.environ.get(variable)
        os.environ[variable] = name
        try:
            yield
        finally:
            if before is None:
                os.environ.pop(variable, None)
            else:
                os.environ[variable] = before


def pactl(*words: str) -> str:
    """What pactl answers; raises DeviceError where it is missing, or the server is or refuses."""
    try:
        done = subprocess.run(["pactl", *words], capture_output=True, text=True, timeout=10)
    except FileNotFoundError:
        raise DeviceError("pactl was not found: apt install pulseaudio-utils") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise DeviceError(f"pactl cannot be run: {' '.join(str(error).split())}") from None
    if done.returncode:
        said = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise DeviceError(f"the sound server did not take 'pactl {' '.join(words)}': {said}; is it running?")
    return done.stdout


def _asked(*words: str) -> str:
    try:
        return pactl(*words)
    except DeviceError:
        return ""
