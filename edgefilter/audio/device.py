"""Sound devices by the names that people type: the only place that imports sounddevice, and not before it is needed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from edgefilter.audio import pulse
from edgefilter.audio.channels import Channels
from edgefilter.audio.port import STREAM_LATENCY_S, InputPort, OutputPort, SpokenReference, silence_alsa
from edgefilter.audio.pulse import STAND_INS, Device, Named
from edgefilter.audio.reader import Reader
from edgefilter.errors import DeviceError, UsageError


def _sounddevice() -> Any:
    """Import sounddevice; raise DeviceError, one line, where it or the PortAudio library is missing or cannot be started."""
    try:
        import sounddevice
    except ImportError:
        missing = "the Python package sounddevice, which is missing: pip install sounddevice"
        raise DeviceError(f"live audio needs {missing}") from None
    except OSError as error:
        raise DeviceError(f"live audio needs the PortAudio library ({error}): apt install libportaudio2") from None
    except Exception as error:  # PortAudioError, which that module alone could name
        why = " ".join(str(error).split())
        raise DeviceError(f"PortAudio cannot be started ({why}): check the configuration of the sound system") from None
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


def _devices() -> list[Device]:
    """PortAudio's devices, then each input and output of the sound server as a copy of the PortAudio device that opens the server."""
    found = _of_portaudio()
    served = []
    for kind in ("input", "output"):
        ways = [device for name in STAND_INS for device in found if device.name == name and device.channels(kind)]
        for name in pulse.names(kind) if ways else ():
            inputs, outputs = (ways[0].inputs, 0) if kind == "input" else (0, ways[0].outputs)
            served.append(replace(ways[0], name=name, pulse_name=name, inputs=inputs, outputs=outputs))
    return found + served


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


def input_port(name: Named, latency_s: float = STREAM_LATENCY_S, channels: Channels | None = None) -> InputPort:
    """An input that can be opened; channels: those that are wanted in place of their mean."""
    device = find(name, "input")
    if device.name in STAND_INS or device.pulse_name:  # PortAudio says 32 of whatever the server has
        device = replace(device, inputs=pulse.channels_of(device.pulse_name) or device.inputs)
    return InputPort(_sounddevice(), device, latency_s, channels)


def output_port(name: Named, queued: int, margin_s: float = 0.0, latency_s: float = STREAM_LATENCY_S) -> OutputPort:
    """An output that can be opened, with room for so many queued samples at 16 kHz."""
    return OutputPort(_sounddevice(), find(name, "output"), queued, margin_s, latency_s)


def speaker(output: Named, speech: Reader) -> SpokenReference:
    """Play this speech on an output device; what is played is the reference of the LiveSource that gets the result."""
    spoken = SpokenReference(_sounddevice(), find(output, "output"), speech.chunks())
    spoken.notes += speech.notes
    return spoken


def match(devices: Sequence[Device], wanted: str | int | None, kind: str, default: int) -> Device:
    """Find the device that `wanted` names, by its name, a part of it or its number (`Named`).

    A whole name is preferred to a part of one; a part that only monitors have in their names is taken last. Capitals,
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
        if text.lower() in ("default", "mic", "speaker") and min(ranks.values(), default=2) > 1:
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

    Those are 'Monitor of NAME', 'NAME.monitor' (or '_', '-' or a space in place of the dot) and 'NAME [Loopback]'. Of an
    output that stands for the whole sound server, 'pulse' say, it is the only monitor there is. Raises UsageError where there is none or
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
