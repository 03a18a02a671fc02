"""A live output that goes on without its device, and with it again when it is back; what could not be played is counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from edgefilter.audio.protocols import Sink
from edgefilter.audio.steady import RETRY_S, clock
from edgefilter.errors import DeviceError
from edgefilter.types import SAMPLE_RATE, Samples


class SteadySink:
    """An output that outlives its device.

    make: the sink of a device that may be away (DeviceError); it is made anew for each return. What comes while the
    device is away is dropped and counted (output_away, samples at 16 kHz). A device that never worked is an error.
    """

    finished = False

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
            self._sink = self._again()
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
            self._retire(error)
            return
        self._own["output_back"] += self._is_away
        self._worked, self._is_away = True, False

    def _again(self) -> Sink | None:
        self._tried_at = clock()
        try:
            sink = self._make()
        except DeviceError:
            return None
        sink.__enter__()
        return sink

    def _retire(self, error: DeviceError) -> None:
        """Let go of a sink whose device stopped; what it counted stays."""
        if self._sink:
            self._earlier.update(self._sink.stats())
            self._sink.__exit__(type(error), error, None)
        self._sink, self._tried_at = None, clock()

    def stats(self) -> dict[str, int]:
        """Those of all its sinks so far, and samples that found no device; how often the device went away and came back."""
        now = self._sink.stats() if self._sink else {}
        return {name: self._earlier[name] + now.get(name, 0) for name in {**self._earlier, **now}} | self._own

    def __exit__(self, *exc: object) -> None:
        if self._sink:
            self._sink.__exit__(*exc)
            self.notes = self._sink.notes
        if self._own["output_gone"]:
            self.notes = [
                *self.notes,
                f"the output device was away for {self._own['output_away'] / SAMPLE_RATE:.1f} s of sound",
            ]
