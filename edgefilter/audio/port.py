"""One PortAudio stream, opened and watched; sounddevice itself is handed in by device.py.

Callbacks only copy between PortAudio's buffer and a ring and count; everything else happens in the reader's thread.
"""

from __future__ import annotations

import ctypes
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from edgefilter.audio.channels import Channels
from edgefilter.audio.fade import Fade
from edgefilter.audio.pairing import BUFFER_S, Inlet, Outlet
from edgefilter.audio.pulse import OPENING, Device, leading_to
from edgefilter.audio.raw import delivered
from edgefilter.dsp.resample import Resampler
from edgefilter.dsp.ring import Ring
from edgefilter.errors import DeviceError
from edgefilter.types import SAMPLE_RATE, Samples

POLL_S = 0.004
"""Between two looks at a device: a quarter of a hop."""
START_S = 6.0
"""How long a device may take to its first samples: a virtual one can hold back its first 2 s."""
STREAM_LATENCY_S = 0.05
"""Buffer asked of the sound system for live use, three hops: it is part of the latency."""


def clock() -> float:
    """Seconds that also pass while the machine sleeps, where the system has such a clock."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


def pause() -> None:
    """Wait until it is worth looking at the devices again."""
    time.sleep(POLL_S)


@cache
def silence_alsa() -> None:
    """Keep ALSA from printing a line for each underrun, hundreds of them; the streams count and tell them.

    Its error handler (snd_lib_error_set_handler) may be any function of C that takes no notice of its arguments.
    """
    try:
        alsa = ctypes.CDLL("libasound.so.2")
    except OSError:  # another audio system
        return
    alsa.snd_lib_error_set_handler(ctypes.CDLL(None).getpid)


@contextmanager
def quiet() -> Iterator[None]:
    """Keep off the terminal what the C libraries print while a stream is opened or closed; errors come back as codes."""
    with OPENING:
        sys.stderr.flush()
        kept = os.dup(2)
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(sink)


class Port:
    """One PortAudio stream and how its rate and channels are brought to 16 kHz mono.

    latency_s: the buffer asked of the sound system, seconds. wanted: of an input, the channels to deliver, in that order;
    None for the mean of all. Raises DeviceError where the device cannot be opened, UsageError where it lacks a wanted channel.
    """

    def __init__(
        self, sounddevice: Any, device: Device, kind: str, latency_s: float, wanted: Channels | None = None
    ) -> None:
        self._sd = sounddevice
        self._name = f"{kind} device '{device}'"
        self.wanted = None if wanted is None else wanted.among(device.channels(kind), self._name)
        self.kind, self.device, self.latency_s = kind, device, latency_s
        self.rate, self.channels = self._settings()
        self.notes: list[str] = []
        if self.rate != SAMPLE_RATE:
            how = f"does not run at {SAMPLE_RATE} Hz: opened at {self.rate} Hz and resampled"
            self.notes.append(f"{self._name} {how}")
        if self.wanted is not None:
            self.notes.append(f"{self._name}: channels {', '.join(map(str, self.wanted))} of {self.channels}")
        elif self.channels > 1:
            how = "averaged" if kind == "input" else "get the same"
            self.notes.append(f"{self._name} has no mono: {self.channels} channels {how}")
        self._stream: Any = None
        self._progress = 0
        self._still_s, self._asked = 0.0, clock()

    def _settings(self) -> tuple[int, int]:
        """Rate and number of channels with which the device can be opened."""
        check = self._sd.check_input_settings if self.kind == "input" else self._sd.check_output_settings
        there = self.device.channels(self.kind)
        least = 1 if self.wanted is None else max(self.wanted) + 1
        counts = {least, max(2, there)} if self.wanted else {1, 2, max(2, there)}
        refusal = ""
        for rate in (SAMPLE_RATE, round(self.device.rate)):
            for channels in sorted(counts):
                try:
                    with quiet():
                        check(device=self.device.index, channels=channels, dtype="float32", samplerate=rate)
                    return rate, channels
                except (self._sd.PortAudioError, ValueError) as error:
                    refusal = refusal or _words(error)
        rates = f"{SAMPLE_RATE} Hz or {self.device.rate:.0f} Hz"
        raise DeviceError(f"{self._name} cannot be opened at {rates}: {refusal}; choose another ('edgefilter devices')")

    def start(self, callback: Any) -> None:
        """Open the stream with this callback; raises DeviceError."""
        make = self._sd.InputStream if self.kind == "input" else self._sd.OutputStream
        settings = {"device": self.device.index, "channels": self.channels, "samplerate": self.rate}
        try:
            with quiet(), leading_to(self.device.pulse_name, self.kind):
                self._stream = make(**settings, dtype="float32", latency=self.latency_s, callback=callback)
                self._stream.start()
        except self._sd.PortAudioError as error:
            why = f"{_words(error)}; is another program using it?"
            raise DeviceError(f"{self._name} cannot be started: {why}") from None

    def check_alive(self, progress: int, patience_s: float = BUFFER_S) -> None:
        """Raise DeviceError once progress, samples or callbacks so far, has stood still for patience_s.

        Only the time counts in which this program was awake: at most a tenth of a second from one call to the next.
        """
        now = clock()
        awake, self._asked = min(now - self._asked, 0.1), now
        self._still_s = 0.0 if progress != self._progress else self._still_s + awake
        self._progress = progress
        if self._still_s > patience_s:
            raise DeviceError(
                f"{self._name} stopped (no sound for {patience_s:.0f} s: unplugged, or the sound server ended): reconnect"
                " it and start again"
            )

    def close(self, drain: bool = False) -> None:
        """End the stream; drain: let the device play what it holds already."""
        if self._stream is None:
            return
        try:
            if drain:  # sound servers drop what is in their buffers when a stream ends
                time.sleep(self._stream.latency + 0.1)
            with quiet():
                self._stream.abort()
                self._stream.close()
        except self._sd.PortAudioError:  # a device that has vanished cannot be stopped; its loss was reported already
            pass
        self._stream = None


def _words(error: Exception) -> str:
    return str(error.args[0] if error.args else error).splitlines()[0]


class InputPort(Port):
    """An input whose callback fills an Inlet, read as 16 kHz mono, or as the channels that are wanted."""

    def __init__(self, sounddevice: Any, device: Device, latency_s: float, wanted: Channels | None) -> None:
        super().__init__(sounddevice, device, "input", latency_s, wanted)
        count = len(self.wanted) if self.wanted else 1
        self.inlet = Inlet(round(BUFFER_S * self.rate), count if count > 1 else None)
        self._resampler = Resampler(self.rate, SAMPLE_RATE, count)

    def open(self) -> None:
        inlet, wanted = self.inlet, self.wanted

        def callback(indata: np.ndarray, _frames: int, _time: Any, status: Any) -> None:
            inlet.receive(delivered(indata, wanted), bool(status.input_overflow), clock())

        self.start(callback)

    def take(self) -> Samples:
        return self._resampler.push(self.inlet.take())


class OutputPort(Port):
    """An output whose callback empties an Outlet; `convert` brings 16 kHz mono to its rate."""

    def __init__(self, sounddevice: Any, device: Device, queued: int, margin_s: float, latency_s: float) -> None:
        super().__init__(sounddevice, device, "output", latency_s)
        self.flags = 0
        self.margin = round(margin_s * self.rate)
        self.outlet = Outlet(round((BUFFER_S + queued / SAMPLE_RATE) * self.rate) + self.margin, self.margin)
        self.convert = Resampler(SAMPLE_RATE, self.rate).push

    def open(self, before: Callable[[], None] = lambda: None) -> None:
        """Start the stream; before is called in each callback, ahead of the delivery, by the audio thread."""
        outlet = self.outlet

        def callback(outdata: np.ndarray, _frames: int, _time: Any, status: Any) -> None:
            self.flags += bool(status.output_underflow)
            before()
            outlet.deliver(outdata[:, 0])
            outdata[:, 1:] = outdata[:, :1]

        self.start(callback)

    def wait_until(self, queued: int) -> None:
        """Return when at most queued samples wait in the ring; raises DeviceError when the device stops."""
        while len(self.outlet.ring) > queued:
            self.check_alive(self.outlet.calls)
            pause()


class SpokenReference(Port):
    """Plays speech, and is read like an input that delivers exactly what is played, gain changes included.

    speech: arrays (n,) at 16 kHz, played from the first `take` on; before and after it there is silence.
    The sound leaves the loudspeaker later than it is read here, by the device's latency.
    """

    def __init__(self, sounddevice: Any, device: Device, speech: Iterator[Samples]) -> None:
        super().__init__(sounddevice, device, "output", STREAM_LATENCY_S)
        self.inlet = Inlet(round(BUFFER_S * self.rate))
        self._ring = Ring(round(BUFFER_S * self.rate))
        self._pieces = self._converted(speech)
        self._back = Resampler(self.rate, SAMPLE_RATE)
        self._fade = Fade()

    def fade(self, gain: float) -> None:
        """Go on with this gain; with 0 the rest of the speech is passed over in silence."""
        self._fade.wanted = gain

    def open(self) -> None:
        """Start the stream, silent at first."""

        def callback(outdata: np.ndarray, _frames: int, _time: Any, status: Any) -> None:
            played = self._next(len(outdata))
            outdata[:] = played[:, None]
            self.inlet.receive(played, bool(status.output_underflow), clock())

        self.start(callback)

    def take(self) -> Samples:
        """What was played since the last call, (n,) at 16 kHz; sees to it that there is more to play."""
        while len(self._ring) < self._ring.capacity // 2 and (piece := next(self._pieces, None)) is not None:
            self._ring.write(piece)
        return self._back.push(self.inlet.take())

    def _next(self, count: int) -> Samples:
        """The next count samples for the device; called by the audio thread."""
        played = np.zeros(count, np.float32)
        speech = self._ring.read(count)
        played[: speech.size] = speech
        return self._fade.apply(played, self.rate)

    def _converted(self, speech: Iterator[Samples]) -> Iterator[Samples]:
        """The speech at the device's rate, in pieces of a quarter of the ring, which is half full when one is added."""
        there, size = Resampler(SAMPLE_RATE, self.rate), round(BUFFER_S * SAMPLE_RATE) // 4
        for chunk in speech:
            for at in range(0, chunk.size, size):
                yield there.push(chunk[at : at + size])
        yield there.push(np.zeros(0, np.float32), last=True)
