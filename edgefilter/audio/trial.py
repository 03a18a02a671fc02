"""A few seconds of listening to some inputs at once: whether they deliver, how loud, and at which pace."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgefilter.audio.port import POLL_S, START_S, InputPort
from edgefilter.dsp.frames import decibels


@dataclass(frozen=True)
class Trial:
    """What one input delivered.

    rate: Hz, at which it was opened. pace: samples per second of this machine's clock, by that rate; 1 is right, good to
    some 0.1 %. level_db, peak_db: of full scale, -120 for digital silence. overruns: callbacks that were marked.
    """

    rate: int
    pace: float
    level_db: float
    peak_db: float
    overruns: int


def listen(ports: Sequence[InputPort], seconds: float = 3.0) -> list[Trial]:
    """Open the inputs, listen until each has run for so long, and close them.

    Raises DeviceError where one cannot be opened or stops.
    """
    heard: list[list[np.ndarray]] = [[] for _ in ports]
    steps: list[list[tuple[float, int]]] = [[] for _ in ports]
    try:
        for port in ports:
            port.open()
        while min((step[-1][0] - step[0][0] if step else 0.0) for step in steps) < seconds:
            for port, parts, step in zip(ports, heard, steps):
                now, received = time.monotonic(), port.inlet.received
                port.check_alive(received, START_S)
                if received > (step[-1][1] if step else 0):
                    step.append((now, received))
                parts.append(port.take())
            time.sleep(POLL_S)
    finally:
        for port in ports:
            port.close()
    return [_judge(port, np.concatenate(parts), step) for port, parts, step in zip(ports, heard, steps)]


def _judge(port: InputPort, sound: np.ndarray, steps: Sequence[tuple[float, int]]) -> Trial:
    """The pace is the slope of a line through the counter, without the first half second in which devices settle."""
    times, received = np.array(steps).T
    settled = times > times[0] + 0.5
    slope = np.polyfit(times[settled] - times[0], received[settled], 1)[0]
    level = float(decibels(float(np.mean(np.square(sound, dtype=np.float64)))))
    peak = float(decibels(float(np.max(np.square(sound), initial=0.0))))
    return Trial(port.rate, float(slope / port.rate), level, peak, port.inlet.flags)
