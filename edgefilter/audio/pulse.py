"""What sound devices are called: by PortAudio, and by PulseAudio (and PipeWire), of which PortAudio only sees 'default' or 'pulse'."""

from __future__ import annotations

import math
import os
import queue
import re
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
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


class Programs:
    """Lowers the streams that programs play on an output of the server, and raises them again.

    A thread of its own asks the server, which takes some 10 ms each time. output: the output's name. refused: called once with
    the reason where no program can be lowered: with flat volumes the server turns the output itself down, which its monitor
    does not show.
    """

    def __init__(self, output: str, refused: Callable[[str], None]) -> None:
        self._output, self._refused = output, refused
        self._wanted: queue.SimpleQueue[float | None] = queue.SimpleQueue()
        self._lowered: dict[str, float] = {}
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Programs:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Leave every stream as loud as it was found."""
        self._wanted.put(None)
        self._thread.join()

    def fade(self, gain: float) -> None:
        """Let what these programs play go on with this gain, above 0 and at most 1; returns at once."""
        self._wanted.put(gain)

    def _run(self) -> None:
        tried = False
        while (gain := self._wanted.get()) is not None:
            self._raise()
            if gain < 1.0:
                before = "" if tried else _asked("get-sink-volume", self._output)
                self._lower(20.0 * math.log10(gain))
                if not tried and _asked("get-sink-volume", self._output) != before:
                    self._refused(
                        "a program's volume moves that of the output: set flat-volumes = no in PulseAudio's daemon.conf"
                    )
                    break
                tried = True
        self._raise()

    def _lower(self, db: float) -> None:
        for stream in streams_on(self._output):
            with suppress(DeviceError):  # it has ended
                pactl("set-sink-input-volume", stream, f"{db:+.2f}dB")
                self._lowered[stream] = db

    def _raise(self) -> None:
        for stream, db in self._lowered.items():
            with suppress(DeviceError):
                pactl("set-sink-input-volume", stream, f"{-db:+.2f}dB")
        self._lowered.clear()


def streams_on(output: str) -> list[str]:
    """Numbers of the streams that programs play on an output of the server now."""
    outputs = (line.split("\t") for line in _asked("list", "short", "sinks").splitlines())
    numbers = [each[0] for each in outputs if len(each) > 1 and each[1] == output]
    streams = (line.split("\t") for line in _asked("list", "short", "sink-inputs").splitlines())
    return [each[0] for each in streams if len(each) > 1 and each[1] in numbers]


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
