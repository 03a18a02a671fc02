"""Speech that this program plays itself: the samples that the loudspeaker gets are the reference."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from edgefilter.audio.lookup import Device
from edgefilter.audio.pairing import BUFFER_S, Inlet
from edgefilter.audio.port import Port
from edgefilter.dsp.resample import Resampler
from edgefilter.dsp.ring import Ring
from edgefilter.types import SAMPLE_RATE, Samples

FADE_S = 0.02
"""How long a change of the gain by one takes: short for an ear, too long for a click."""


class SpokenReference(Port):
    """Plays speech, and is read like an input that delivers exactly what is played, gain changes included.

    speech: arrays (n,) at 16 kHz, played from the first `take` on; before and after it there is silence.
    The sound leaves the loudspeaker later than it is read here, by the device's latency.
    """

    def __init__(self, sounddevice: Any, device: Device, speech: Iterator[Samples]) -> None:
        super().__init__(sounddevice, device, "output")
        self.inlet = Inlet(round(BUFFER_S * self.rate))
        self._ring = Ring(round(BUFFER_S * self.rate))
        self._pieces = self._converted(speech)
        self._back = Resampler(self.rate, SAMPLE_RATE)
        self._gain = self._wanted = 1.0
        self._step = 1.0 / (FADE_S * self.rate)

    def fade(self, gain: float) -> None:
        """Go on with this gain; with 0 the rest of the speech is passed over in silence."""
        self._wanted = gain

    def open(self) -> None:
        """Start the stream, silent at first."""

        def callback(outdata: np.ndarray, _frames: int, _time: Any, status: Any) -> None:
            played = self._next(len(outdata))
            outdata[:] = played[:, None]
            self.inlet.receive(played, bool(status.output_underflow))

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
        if self._gain != 1.0 or self._wanted != 1.0:
            reach = self._step * np.arange(1, count + 1)
            gains = self._gain + np.clip(self._wanted - self._gain, -reach, reach)
            self._gain = float(gains[-1])
            played *= gains.astype(np.float32)
        return played

    def _converted(self, speech: Iterator[Samples]) -> Iterator[Samples]:
        """The speech at the device's rate, in pieces of a quarter of the ring, which is half full when one is added."""
        there, size = Resampler(SAMPLE_RATE, self.rate), round(BUFFER_S * SAMPLE_RATE) // 4
        for chunk in speech:
            for at in range(0, chunk.size, size):
                yield there.push(chunk[at : at + size])
        yield there.push(np.zeros(0, np.float32), last=True)
