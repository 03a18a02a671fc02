"""PulseAudio's (and PipeWire's) own names for what PortAudio only sees as 'default' or 'pulse': above all, the monitors."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager

STAND_INS = ("pulse", "default", "pipewire")
"""PortAudio devices that lead to the sound server, the most direct first."""
OPENING = threading.RLock()
"""Held while a stream is opened: what that changes is the whole process's, and two at once would undo each other's."""


def sources() -> list[str]:
    """Names of all inputs of the running server, monitors included; empty where there is none."""
    return [line.split("\t")[1] for line in _pactl("list", "short", "sources").splitlines() if line.count("\t") >= 1]


def default_monitor() -> str | None:
    """Name of the monitor of the default output, None where there is no server or no such monitor."""
    name = _pactl("get-default-sink").strip() + ".monitor"
    return name if name in sources() else None


@contextmanager
def reading_from(source: str) -> Iterator[None]:
    """While a stream is opened: let the stand-in lead to this source; '' changes nothing.

    PortAudio opens the devices of its list and takes no name of the server's. The environment is all that libpulse
    reads beside that, once, when the stream connects (pulseaudio(1), PULSE_SOURCE); so the variable is set for that
    moment, for one stream at a time.
    """
    if not source:
        yield
        return
    with OPENING:
        before = os.environ.get("PULSE_SOURCE")
        os.environ["PULSE_SOURCE"] = source
        try:
            yield
        finally:
            if before is None:
                os.environ.pop("PULSE_SOURCE", None)
            else:
                os.environ["PULSE_SOURCE"] = before


def _pactl(*words: str) -> str:
    try:
        return subprocess.run(["pactl", *words], capture_output=True, text=True, timeout=5).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""
