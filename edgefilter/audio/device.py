"""Sound devices by the names that people type: the only place that imports sounddevice, and not before it is needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

from edgefilter.audio import pulse
from edgefilter.audio.lookup import STAND_INS, Device, Named, match, monitor
from edgefilter.audio.port import STREAM_LATENCY_S, InputPort, OutputPort, silence_alsa
from edgefilter.audio.reader import Reader
from edgefilter.audio.speech import SpokenReference
from edgefilter.errors import DeviceError


def _sounddevice() -> Any:
    """Import sounddevice; raise DeviceError, one line, where it or the PortAudio library is missing."""
    try:
        import sounddevice
    except ImportError:
        missing = "the Python package sounddevice, which is missing: pip install sounddevice"
        raise DeviceError(f"live audio needs {missing}") from None
    except OSError as error:
        raise DeviceError(f"live audio needs the PortAudio library ({error}): apt install libportaudio2") from None
    silence_alsa()
    return sounddevice


def _of_portaudio() -> list[Device]:
    sd = _sounddevice()
    apis = [api["name"] for api in sd.query_hostapis()]
    found = []
    for index, d in enumerate(sd.query_devices()):
        channels = d["max_input_channels"], d["max_output_channels"]
        found.append(Device(index, d["name"], *channels, d["default_samplerate"], apis[d["hostapi"]]))
    return found


def _of_server(found: list[Device]) -> Iterator[Device]:
    """The sound server's inputs and outputs, each behind the device of PortAudio's that leads to the server."""
    for kind in ("input", "output"):
        ways = [device for name in STAND_INS for device in found if device.name == name and device.channels(kind)]
        for name in pulse.names(kind) if ways else ():
            inputs, outputs = (ways[0].inputs, 0) if kind == "input" else (0, ways[0].outputs)
            yield replace(ways[0], name=name, pulse_name=name, inputs=inputs, outputs=outputs)


def _devices() -> list[Device]:
    found = _of_portaudio()
    return [*found, *_of_server(found)]


def list_devices() -> list[dict[str, Any]]:
    """PortAudio's devices, one dict each: index, name, inputs, outputs (channels), rate (Hz, its own), system."""
    return [asdict(device) for device in _of_portaudio()]


def find(name: Named, kind: str) -> Device:
    """The device that is meant; kind: 'input' or 'output'. Raises as match."""
    if isinstance(name, Device):
        return name
    return match(_devices(), name, kind, _sounddevice().default.device[0 if kind == "input" else 1])


def monitor_of(output: Named = None) -> Device:
    """The input that gets what output plays (default: the default output); UsageError where there is none."""
    device, devices = find(output, "output"), _devices()
    source = pulse.monitor(pulse.default_name("output")) if device.name in STAND_INS else None
    found = [each for each in devices if source and each.pulse_name == source]
    return found[0] if found else monitor(devices, device)


def input_port(name: Named, latency_s: float = STREAM_LATENCY_S, channels: Sequence[int] | None = None) -> InputPort:
    """An input that can be opened; channels: numbers, from 0, of those that are wanted, or ALL_CHANNELS."""
    device = find(name, "input")
    if device.name in STAND_INS or device.pulse_name:  # PortAudio says 32 of whatever the server has
        device = replace(device, inputs=pulse.channels_of(device.pulse_name) or device.inputs)
    return InputPort(_sounddevice(), device, latency_s, channels)


def output_port(name: Named, queued: int, margin_s: float = 0.0, latency_s: float = STREAM_LATENCY_S) -> OutputPort:
    """An output that can be opened, with room for so many queued samples at 16 kHz."""
    return OutputPort(_sounddevice(), find(name, "output"), queued, margin_s, latency_s)


def speaker(output: Named, speech: Reader) -> SpokenReference:
    """Speech for an output device, to be the reference of a LiveSource."""
    spoken = SpokenReference(_sounddevice(), find(output, "output"), speech.chunks())
    spoken.notes += speech.notes
    return spoken
