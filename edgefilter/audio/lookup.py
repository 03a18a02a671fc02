"""Finding a sound device by what people type, and the monitor that gets what an output plays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from edgefilter.errors import DeviceError, UsageError

_DEFAULT_WORDS = ("default", "mic", "speaker")
STAND_INS = ("pulse", "default", "pipewire")
"""PortAudio's devices that lead to the sound server, the most direct first."""


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


def match(devices: Sequence[Device], wanted: str | int | None, kind: str, default: int) -> Device:
    """The device that wanted names, as of Named.

    A whole name goes before a part of one, and a part that only a monitor has in it is the last that is taken. Capitals,
    dots, dashes and underlines do not matter in a part. kind: 'input' or 'output'; default: index of the system's
    default, -1 for none. Raises UsageError for an unknown or ambiguous name, DeviceError where there is no device of
    this kind at all.
    """
    usable = [device for device in devices if device.channels(kind)]
    if not usable:
        todo = "connect one, or check that the sound server runs ('edgefilter devices')"
        raise DeviceError(f"no sound device with an {kind} was found: {todo}")
    text = "default" if wanted is None else str(wanted).strip()
    own = [device for device in usable if not device.pulse_name]
    if text.isdigit():
        found = [device for device in own if device.index == int(text)]
    else:
        ranks = {device: rank for device in usable if (rank := _rank(device, text)) is not None}
        found = [device for device, rank in ranks.items() if rank == min(ranks.values())]
        if text.lower() in _DEFAULT_WORDS and min(ranks.values(), default=2) > 1:
            found = [device for device in own if device.index == default] or (own if len(own) == 1 else [])
            if not found:
                raise UsageError(f"there is no default {kind} device; name one of {_names(usable)}")
    if not found:
        raise UsageError(f"{kind} device '{text}' is unknown; expected one of {_names(usable)}")
    if len(found) > 1:
        matches = f"{_names(found)}: give the number or more of the name"
        raise UsageError(f"{kind} device '{text}' is ambiguous; it matches {matches}")
    return found[0]


def _rank(device: Device, text: str) -> int | None:
    """How well a device is named by text, 0 best: by its name, by a part of it; PortAudio's devices or the server's first."""
    of_server = bool(device.pulse_name)
    if device.name.lower() == text.lower():
        return int(of_server)
    plain, part = _plain(device.name), _plain(text)
    if part not in plain:
        return None
    return 4 if "monitor" in plain.replace(part, "") else 3 - of_server


def monitor(devices: Sequence[Device], output: Device) -> Device:
    """The input that gets what output plays, by the names that PulseAudio, PipeWire and Windows give it.

    Those are 'Monitor of NAME', 'NAME.monitor' ('_', '-' or a space between as well) and 'NAME [Loopback]'. For an
    output that only leads to the sound server, the single monitor there is. Raises UsageError where there is none or
    more than one.
    """
    plain = _plain(output.name)
    names = {f"monitor of {plain}", f"{plain} monitor", f"{plain} loopback"}
    inputs = [device for device in devices if device.inputs]
    found = [device for device in inputs if _plain(device.name) in names]
    found = [device for device in found if bool(device.pulse_name) == bool(output.pulse_name)] or found
    if not found and output.name in STAND_INS:
        found = [device for device in inputs if re.search(r"\b(monitor|loopback)\b", _plain(device.name))]
    if len(found) == 1:
        return found[0]
    if found:
        several = f"{_names(found)}: choose one with --reference"
        raise UsageError(f"output '{output}' has more than one possible monitor, {several}")
    raise UsageError(
        f"output '{output}' has no monitor input that gets what the robot says: name an input with --reference, or"
        " define one for PulseAudio or PipeWire in ~/.asoundrc: pcm.robot_monitor { type pulse device SINK.monitor }"
    )


def _plain(name: str) -> str:
    """Lower case, with every run of separators and brackets as one space."""
    return re.sub(r"[\s._\-\[\]()]+", " ", name.lower()).strip()


def _names(devices: Sequence[Device]) -> str:
    """What can be typed for each: the sound server's names; PortAudio's numbers and names, without its ways to the server."""
    named = [device for device in devices if device.pulse_name]
    others = [device for device in devices if not (device.pulse_name or (named and device.name in STAND_INS))]
    return ", ".join([*(f"'{device}'" for device in named), *(f"{device.index} '{device}'" for device in others)])
