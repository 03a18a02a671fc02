"""A PortAudio of virtual devices on a virtual clock: what the sound system does to a run, in no time and the same each time."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

CALLBACK_S = 0.02


class PortAudioError(Exception):
    pass


@dataclass
class VirtualDevice:
    """One device. takes: (rate, channels) that it can be opened with, None for any. plugged: whether it is there.

    ppm: by how much its clock is fast. swallows: seconds of sound that its driver loses without a word. holds: seconds of
    sound that come late, all at once. needs_s: buffer below which each callback is marked as late. level: every sample of an
    input. sound: what an input hears in place of that, from its start on. channels: how many it has; of more than two the
    k-th, from 0, sounds as loud as k + 1 tenths. hears: the output whose sound this input gets, a callback later.
    """

    name: str
    kind: str
    rate: float = 16000.0
    takes: tuple[int, int] | None = None
    plugged: bool = True
    ppm: float = 0.0
    swallows: float = 0.0
    holds: float = 0.0
    needs_s: float = 0.0
    level: float = 0.25
    sound: np.ndarray | None = None
    channels: int = 2
    hears: VirtualDevice | None = None
    played: list = field(default_factory=list)


class Stream:
    latency = 0.0

    def __init__(self, system: VirtualPortAudio, device: VirtualDevice, rate, channels, latency, callback) -> None:
        if not device.plugged:
            raise PortAudioError("Device unavailable", -9985)
        self.system, self.device, self.rate, self.channels, self.callback = system, device, rate, channels, callback
        self.running, self.due, self.count, self.late = False, system.now, 0, latency < device.needs_s
        self.begun, self.held = system.now, 0

    def start(self) -> None:
        self.running = True
        self.system.streams.append(self)

    def abort(self) -> None:
        self.running = False

    def close(self) -> None:
        self.running = False

    def advance(self, now: float) -> None:
        """The callbacks that are due by now."""
        while self.running and self.due + CALLBACK_S <= now:
            self.due += CALLBACK_S
            if not self.device.plugged:
                continue
            if self.device.swallows > 0.0:
                self.device.swallows -= CALLBACK_S
                continue
            if self.device.holds > 0.0:
                self.device.holds -= CALLBACK_S
                self.held += 1
                continue
            while self.held:
                self.held -= 1
                self.call(self.due - (self.held + 1) * CALLBACK_S)
            self.call(self.due)

    def call(self, due: float) -> None:
        """The callback with the sound that ended then."""
        size = round((self.count + 1) * CALLBACK_S * self.rate * (1 + 1e-6 * self.device.ppm)) - round(
            self.count * CALLBACK_S * self.rate * (1 + 1e-6 * self.device.ppm)
        )
        self.count += 1
        status = SimpleNamespace(input_overflow=self.late, output_underflow=self.late)
        if self.device.kind == "input":
            sound = np.full((size, self.channels), self.device.level, np.float32)
            if self.device.channels > 2:
                sound = np.tile(0.1 * np.arange(1, self.channels + 1, dtype=np.float32), (size, 1))
            if self.device.sound is not None:
                upto = round((due - self.begun) * self.rate)
                sound = np.repeat(self.device.sound[upto - size : upto, None], self.channels, axis=1)
            if heard := self.device.hears:
                sound = heard.played.pop(0)[:, None] if heard.played else 0 * sound
            self.callback(sound, size, None, status)
        else:
            out = np.zeros((size, self.channels), np.float32)
            self.callback(out, size, None, status)
            self.device.played.append(out[:, 0])


class VirtualPortAudio:
    """What edgefilter uses of the module sounddevice, and of the module time."""

    CLOCK_BOOTTIME = 7
    PortAudioError = PortAudioError

    def __init__(self, *devices: VirtualDevice) -> None:
        self.devices, self.streams, self.now = devices, [], 1000.0
        self.plan: list[tuple[float, object]] = []
        self.default = SimpleNamespace(
            device=[next((i for i, d in enumerate(devices) if d.kind == kind), -1) for kind in ("input", "output")]
        )

    def at(self, seconds: float, action) -> None:
        """Call action once so many seconds from now have passed."""
        self.plan.append((self.now + seconds, action))

    def monotonic(self) -> float:
        return self.now

    def clock_gettime(self, clock: int) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        for entry in [entry for entry in self.plan if entry[0] <= self.now]:
            self.plan.remove(entry)
            entry[1]()
        for stream in self.streams:
            stream.advance(self.now)

    def pass_by(self, seconds: float) -> None:
        """Time in which nothing runs, the drivers neither."""
        self.now += seconds
        for stream in self.streams:
            stream.due += seconds

    def query_hostapis(self) -> list[dict]:
        return [{"name": "virtual"}]

    def query_devices(self) -> list[dict]:
        return [
            {
                "name": device.name,
                "hostapi": 0,
                "max_input_channels": device.channels * (device.kind == "input"),
                "max_output_channels": 2 * (device.kind == "output"),
                "default_samplerate": device.rate,
            }
            for device in self.devices
        ]

    def _check(self, device: int, channels: int, dtype: str, samplerate: int) -> None:
        found = self.devices[device]
        if not found.plugged:
            raise PortAudioError("Device unavailable", -9985)
        if found.takes not in (None, (samplerate, channels)):
            raise PortAudioError("Invalid sample rate", -9997)

    check_input_settings = check_output_settings = _check

    def _stream(self, device: int, channels: int, samplerate: int, dtype: str, latency: float, callback) -> Stream:
        return Stream(self, self.devices[device], samplerate, channels, latency, callback)

    InputStream = OutputStream = _stream
