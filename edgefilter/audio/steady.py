"""An input and an output that go on without their devices, use them again when they are back, and count what is missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from edgefilter.audio.pairing import BUFFER_S
from edgefilter.audio.port import START_S, InputPort, SpokenReference, clock
from edgefilter.audio.protocols import Sink
from edgefilter.audio.sample_clock import Lateness, SampleClock
from edgefilter.errors import DeviceError
from edgefilter.types import SAMPLE_RATE, Samples

RETRY_S = 1.0
"""Between two attempts to open a device that is away."""
LATENESS = Lateness(look_s=0.5)
"""Longer than callbacks are late on a busy machine."""


class SteadyInput:
    """An input port that goes on without its device.

    make: makes the port; DeviceError where the device is away. patience_s: how long it may be away; with 0 its loss is
    an error at once. While it is away, `take` gives silence by the clock. filled: samples of this silence so far.
    gone, back: how often the device was lost and found again.
    """

    def __init__(self, make: Callable[[], InputPort | SpokenReference], patience_s: float) -> None:
        self._make, self._patience_s = make, patience_s
        self.port = make()
        self.filled = self.gone = self.back = 0
        self._earlier_lost = self._earlier_overruns = 0
        self._open, self._clock = False, SampleClock(LATENESS)
        self._failure: DeviceError | None = None
        self._latest = np.zeros(0, np.float32)
        self._received_at = self._gone_at = self._tried_at = 0.0

    def open(self) -> None:
        """Open the device; raises DeviceError."""
        self.port.open()
        self._open, self._received_at = True, clock()

    def close(self) -> None:
        """End the stream."""
        self.port.close()
        self._open = False

    @property
    def lost(self) -> int:
        """Samples at 16 kHz that did not fit into the ring: silence stands in."""
        return self._earlier_lost + round(self.port.inlet.lost / self.port.rate * SAMPLE_RATE)

    @property
    def doubts(self) -> bool:
        """Whether sound is late, so that it is not clear yet what was lost."""
        return self._clock.doubts or clock() - self._received_at > LATENESS.held_s

    @property
    def missed(self) -> int:
        """Samples at 16 kHz that never came: nothing stands in."""
        return round(self._clock.missed * SAMPLE_RATE)

    @property
    def drifted(self) -> int:
        """Samples at 16 kHz by which the device's clock has fallen behind besides."""
        return round(self._clock.drifted * SAMPLE_RATE)

    @property
    def overruns(self) -> int:
        """Callbacks that the driver marked, of all streams so far."""
        return self._earlier_overruns + self.port.inlet.flags

    def take(self) -> Samples:
        """What came since the last call (n,) or (n, channels), or as much silence as time has passed while the device is away."""
        now = clock()
        samples = self.port.take() if self._open else self._latest[:0]
        self._latest = samples
        if self._failure is None:
            if len(samples):
                received, self._received_at = self.port.inlet.latest
                self._clock.note(received / self.port.rate, self._received_at)
            return samples
        missing = max(round((now - self._received_at) * SAMPLE_RATE) - len(samples), 0)
        silence = np.zeros((missing, *samples.shape[1:]), np.float32)
        self.filled += missing
        if not len(samples):
            self._received_at += missing / SAMPLE_RATE
            return silence
        self.back += 1
        self._failure, self._received_at = None, now
        return np.concatenate((silence, samples))

    def check(self) -> None:
        """See whether the device is there, and try to get it back where it is not; raises DeviceError when patience is over."""
        try:
            if self._open:
                self.port.check_alive(self.port.inlet.received, START_S if self._failure else BUFFER_S)
        except DeviceError as error:
            if self._patience_s <= 0.0:
                raise
            self.close()
            if self._failure is None:
                self._failure, self._gone_at = error, self._received_at
                self._clock.restart()
                self.gone += 1
        now = clock()
        if self._failure and not self._open and now - self._tried_at >= RETRY_S:
            if now - self._gone_at >= self._patience_s:
                raise self._failure
            self._tried_at = now
            self._reopen()

    def _reopen(self) -> None:
        port = None
        try:
            port = self._make()
            port.open()
        except DeviceError:
            if port:
                port.close()
            return
        if port is not self.port:
            self._earlier_lost, self._earlier_overruns = self.lost, self.overruns
        self.port, self._open = port, True


class SteadySink(Sink):
    """An output that goes on without its device.

    make: makes the device's sink, again for each return; DeviceError where the device is away. What is written while it
    is away is dropped and counted (output_away, samples at 16 kHz). A device that never worked is an error.
    """

    def __init__(self, make: Callable[[], Sink]) -> None:
        self._make = make
        self._sink: Sink | None = make()
        self.notes = self._sink.notes
        self._worked = self._is_away = False
        self._tried_at = 0.0
        self._earlier: Counter[str] = Counter()
        self._own = {"output_away": 0, "output_gone": 0, "output_back": 0}

    def __enter__(self) -> SteadySink:
        if self._sink:
            self._sink.__enter__()
        return self

    def write(self, samples: Samples) -> None:
        """Play samples (n,), or drop them while there is no device."""
        if self._sink is None and clock() - self._tried_at >= RETRY_S:
            self._tried_at = clock()
            with suppress(DeviceError):  # still away
                self._sink = self._make().__enter__()
        if self._sink is None:
            self._own["output_away"] += samples.size
            return
        try:
            self._sink.write(samples)
        except DeviceError as error:
            if not self._worked:
                raise
            self._own["output_away"] += samples.size
            self._own["output_gone"] += not self._is_away
            self._is_away = True
            self._earlier.update(self._sink.stats())  # what it counted stays
            self._sink.__exit__(type(error), error, None)
            self._sink, self._tried_at = None, clock()
            return
        self._own["output_back"] += self._is_away
        self._worked, self._is_away = True, False

    def stats(self) -> dict[str, int]:
        """The sums over all its sinks so far; samples that found no device; how often the device was lost and found again."""
        now = self._sink.stats() if self._sink else {}
        return {name: self._earlier[name] + now.get(name, 0) for name in {**self._earlier, **now}} | self._own

    def __exit__(self, *exc: object) -> None:
        if self._sink:
            self._sink.__exit__(*exc)
            self.notes = self._sink.notes
        if self._own["output_gone"]:
            away_s = self._own["output_away"] / SAMPLE_RATE
            self.notes = [*self.notes, f"the output device was away for {away_s:.1f} s of sound"]
