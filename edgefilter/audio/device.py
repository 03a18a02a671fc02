"""Sound devices by the names that people type: the only place that imports sounddevice, and not before it is needed."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

from edgefilter.audio import pulse
from edgefilter.audio.lookup import Device, match, monitor
from edgefilter.audio.port import InputPort, OutputPort
from edgefilter.audio.reader import Reader
from edgefilter.audio.speech import SpokenReference
from edgefilter.errors import DeviceError, UsageError


def _sounddevice() -> Any:
    """Import sounddevice; raise DeviceError, one line, where it or the PortAudio library is missing."""
    try:
        import sounddevice
    except ImportError:
        raise DeviceError(
            "live audio needs the Python package sounddevice, which is missing: pip install sounddevice"
        ) from None
    except OSError as error:
        raise DeviceError(f"live audio needs the PortAudio library ({error}): apt install libportaudio2") from None
    return sounddevice


def _devices() -> list[Device]:
    sd = _sounddevice()
    systems = [api["name"] for api in sd.query_hostapis()]
    return [
        Device(
            i,
            d["name"],
            d["max_input_channels"],
            d["max_output_channels"],
            d["default_samplerate"],
            systems[d["hostapi"]],
        )
        for i, d in enumerate(sd.query_devices())
    ]


def list_devices() -> list[dict[str, Any]]:
    """One dict a device: index, name, inputs, outputs (channels), rate (Hz, its own), system."""
    return [asdict(device) for device in _devices()]


def find(name: str | int | Device | None, kind: str) -> Device:
    """The device called name, numbered so, or with name in its name; None, 'default' and 'mic' are the default one.

    kind: 'input' or 'output'. Raises UsageError for an unknown or ambiguous name, DeviceError without any device.
    """
    default = _sounddevice().default.device[0 if kind == "input" else 1]
    try:
        return match(_devices(), name, kind, default)
    except UsageError:
        if name in pulse.names(kind) and (device := _on_server(str(name), kind)):
            return device
        raise


def monitor_of(output: str | int | Device | None = None) -> Device:
    """The input that hears what output plays (default: the default output); UsageError where there is none."""
    device = find(output, "output")
    if device.name in pulse.STAND_INS and (source := pulse.default_monitor()):
        found = _on_server(source, "input")
        if found:
            return found
    return monitor(_devices(), device)


def _on_server(name: str, kind: str) -> Device | None:
    """The sound server's input or output of this name as a device, None where PortAudio has no way to the server."""
    for stand_in in pulse.STAND_INS:
        for device in _devices():
            if device.name == stand_in and device.channels(kind):
                return replace(device, name=name, pulse_name=name)
    return None


def input_port(name: str | int | Device | None) -> InputPort:
    """An input that can be opened, found by what people type."""
    return InputPort(_sounddevice(), find(name, "input"))


def output_port(name: str | int | Device | None, queued: int, margin_s: float = 0.0) -> OutputPort:
    """An output that can be opened, with room for so many samples at 16 kHz, found by what people type."""
    return OutputPort(_sounddevice(), find(name, "output"), queued, margin_s)


def speaker(output: str | int | Device | None, speech: Reader) -> SpokenReference:
    """Speech for an output device, to be the reference of a LiveSource."""
    spoken = SpokenReference(_sounddevice(), find(output, "output"), speech.chunks())
    spoken.notes += speech.notes
    return spoken
