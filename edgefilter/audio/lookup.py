"""Finding a sound device by what people type, and the monitor that hears what an output plays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from edgefilter.errors import DeviceError, UsageError

_DEFAULT_WORDS = ("default", "mic", "speaker")


@dataclass(frozen=True)
class Device:
    """A sound device as the audio system lists it: number, name, channels each way, its own rate in Hz, its audio system.

    pulse_name: where the device only stands for the sound server, the server's input or output that is meant.
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


def match(devices: Sequence[Device], wanted: str | int | Device | None, kind: str, default: int = -1) -> Device:
    """The device that wanted names: a number, a name, a part of a name, or None, 'default', 'mic' for the default one.

    kind: 'input' or 'output'; default: index of the system's default, -1 for none.
    Raises UsageError for an unknown or ambiguous name, DeviceError where there is no device of this kind at all.
    """
    if isinstance(wanted, Device):
        return wanted
    usable = [device for device in devices if device.channels(kind)]
    if not usable:
        raise DeviceError(
            f"no sound device with an {kind} was found: connect one, or check that the sound server runs ('edgefilter"
            " devices')"
        )
    text = "default" if wanted is None else str(wanted).strip()
    if text.isdigit():
        found = [device for device in usable if device.index == int(text)]
    else:
        found = [device for device in usable if device.name.lower() == text.lower()]
        if not found and text.lower() in _DEFAULT_WORDS:
            found = [device for device in usable if device.index == default] or (usable if len(usable) == 1 else [])
            if not found:
                raise UsageError(f"there is no default {kind} device; name one of {_names(usable)}")
        found = found or [device for device in usable if text.lower() in device.name.lower()]
    if not found:
        raise UsageError(f"{kind} device '{text}' is unknown; expected one of {_names(usable)}")
    if len(found) > 1:
        raise UsageError(
            f"{kind} device '{text}' is ambiguous; it matches {_names(found)}: give the number or more of the name"
        )
    return found[0]


def monitor(devices: Sequence[Device], output: Device) -> Device:
    """The input that hears what output plays, by the names that PulseAudio, PipeWire and Windows give it.

    Understood are 'Monitor of NAME', NAME followed by 'monitor' ('.', '_', '-' or a space between) and 'NAME
    [Loopback]'. For an output that only stands for another ('default', 'pulse', 'pipewire'), the single monitor there
    is. Raises UsageError, one line, where there is none or more than one.
    """
    plain = _plain(output.name)
    names = {f"monitor of {plain}", f"{plain} monitor", f"{plain} loopback"}
    inputs = [device for device in devices if device.inputs]
    found = [device for device in inputs if _plain(device.name) in names]
    if not found and plain in ("default", "pulse", "pipewire", "sysdefault"):
        found = [device for device in inputs if re.search(r"\b(monitor|loopback)\b", _plain(device.name))]
    if len(found) == 1:
        return found[0]
    if found:
        raise UsageError(
            f"output '{output}' has more than one possible monitor, {_names(found)}: choose one with --reference"
        )
    raise UsageError(
        f"output '{output}' has no monitor input that hears what the robot says: name an input with --reference, or"
        " define one for PulseAudio or PipeWire in ~/.asoundrc: pcm.robot_monitor { type pulse device SINK.monitor }"
    )


def _plain(name: str) -> str:
    """Lower case, with every run of separators and brackets as one space."""
    return re.sub(r"[\s._\-\[\]()]+", " ", name.lower()).strip()


def _names(devices: Sequence[Device]) -> str:
    return ", ".join(f"{device.index} '{device.name}'" for device in devices)
