"""A sound played and recorded at the same time: what a calibration needs of two devices."""

from __future__ import annotations

import time

import numpy as np

from edgefilter.audio.device import input_port, output_port
from edgefilter.audio.lookup import Device
from edgefilter.audio.port import POLL_S, START_S
from edgefilter.errors import DeviceError
from edgefilter.types import SAMPLE_RATE, Samples

LEAD_S, GUARD_S = 0.25, 0.05
"""Silence ahead of the sound, and how far the counters of the two streams may be out at their start."""


def play_and_record(
    output: str | int | Device | None, microphone: str | int | Device | None, samples: Samples, tail_s: float = 1.0
) -> Samples:
    """Play samples (n,) at 16 kHz and return what the microphone hears from the moment playing starts, (n + tail,) float32.

    Both are on one sample counter up to a constant: the devices' buffers, and GUARD_S, appear as additional delay, so
    that the sound never seems to be heard before it is played. Silence goes first, since sound servers swallow a
    stream's start. Raises DeviceError where anything was lost on the way, since a calibration with a hole in it
    measures the hole.
    """
    mic = input_port(microphone)
    played = np.concatenate((np.zeros(round(LEAD_S * SAMPLE_RATE), np.float32), samples.astype(np.float32)))
    speaker = output_port(output, played.size)
    speaker.outlet.ring.write(speaker.convert(played, last=True))
    speaker.outlet.draining.set()  # nothing follows: silence after the last sample is no underrun
    begun: list[int] = []

    def mark() -> None:
        if not begun:
            begun.append(mic.inlet.received)

    heard: list[Samples] = []
    wanted = samples.size + round(tail_s * SAMPLE_RATE)
    skipped = (LEAD_S - GUARD_S) * SAMPLE_RATE
    try:
        mic.open()
        while not mic.inlet.calls:
            mic.check_alive(mic.inlet.received, START_S)
            time.sleep(POLL_S)
        speaker.open(mark)
        while not begun or sum(part.size for part in heard) < wanted + skipped + 1 + begun[0] * SAMPLE_RATE / mic.rate:
            mic.check_alive(mic.inlet.received, START_S)
            speaker.check_alive(speaker.outlet.calls, START_S)
            heard.append(mic.take())
            time.sleep(POLL_S)
    finally:
        mic.close()
        speaker.close()
    if mic.inlet.lost or mic.inlet.flags or speaker.flags:
        raise DeviceError(
            f"the recording has holes: {mic.inlet.lost} samples lost, {mic.inlet.flags} overruns, {speaker.flags}"
            " underruns; close other programs and measure again"
        )
    first = round(begun[0] * SAMPLE_RATE / mic.rate + skipped)
    return np.concatenate(heard)[first : first + wanted]
