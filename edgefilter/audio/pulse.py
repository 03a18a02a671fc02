"""PulseAudio's (and PipeWire's) own names for what PortAudio only sees as 'default' or 'pulse': above all, the monitors."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

STAND_INS = ("pulse", "default", "pipewire")
"""PortAudio devices that lead to the sound server, the most direct first."""


def sources() -> list[str]:
    """Names of all inputs of the running server, monitors included; empty where there is none."""
    return [line.split("\t")[1] for line in _pactl("list", "short", "sources").splitlines() if line.count("\t") >= 1]


def default_monitor() -> str | None:
    """Name of the monitor of the default output, None where there is no server or no such monitor."""
    name = _pactl("get-default-sink").strip() + ".monitor"
    return name if name in sources() else None


@contextmanager
def reading_from(source: str) -> Iterator[None]:
    """While a stream is opened: let the stand-in lead to this source (libpulse reads PULSE_SOURCE then); '' changes nothing."""
    before = os.environ.get("PULSE_SOURCE")
    if source:
        os.environ["PULSE_SOURCE"] = source
    try:
        yield
    finally:
        if source:
            os.environ.pop("PULSE_SOURCE")
        if before is not None:
            os.environ["PULSE_SOURCE"] = before


def _pactl(*words: str) -> str:
    try:
        return subprocess.run(["pactl", *words], capture_output=True, text=True, timeout=5).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""
