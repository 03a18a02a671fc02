"""Measurements on devices: a sound played and recorded at the same time, and a few seconds of listening to some inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from edgefilter.audio import virtual
from edgefilter.audio.channels import Channels
from edgefilter.audio.device import input_port, output_port
from edgefilter.audio.port import START_S, STREAM_LATENCY_S, InputPort, OutputPort, clock, pause
from edgefilter.audio.protocols import Source
from edgefilter.audio.pulse import Named
from edgefilter.dsp.frames import decibels
from edgefilter.types import SAMPLE_RATE, Block, Samples


def play_and_record(
    output: Named,
    microphone: Named,
    samples: Samples,
    latency_s: float = STREAM_LATENCY_S,
    tell: Callable[[float], None] = lambda left_s: None,
    channels: Channels | None = None,
    keep: Callable[[Samples], None] = lambda recorded: None,
) -> tuple[Samples, str]:
    """Play samples (n,) at 16 kHz and return what the microphone hears until a second after them, and what was lost, in words.

    That is (n + 16000,), or (n + 16000, channels), from the moment playing starts, on one sample counter up to a
    constant: the devices' buffers appear as additional delay, so that the sound never seems to arrive before it is
    played. Silence goes first, since sound servers swallow a stream's start.
    latency_s: the buffers asked of the sound system; the larger, the fewer holes. tell: called again and again with the
    seconds that are left. channels: those that are wanted in place of their mean. keep: called with
    what was recorded, also where a device stops or an interrupt comes before its end, if it has begun.
    Raises DeviceError where a device cannot be opened or stops, UsageError for the virtual microphone, which hears nothing.
    """
    mic = input_port(microphone, latency_s, channels)
    virtual.refuse_own(mic.device)
    lead = np.zeros(round((latency_s + STREAM_LATENCY_S) * SAMPLE_RATE), np.float32)
    played = np.concatenate((lead, samples))
    speaker = _holding(output, played, latency_s)
    begun: list[int] = []

    def mark() -> None:
        if not begun:
            begun.append(mic.inlet.received)

    parts: list[Samples] = []
    wanted = samples.size + SAMPLE_RATE
    first, left = 0, wanted
    try:
        mic.open()
        while not mic.inlet.received:
            mic.check_alive(mic.inlet.received, START_S)
            pause()
        speaker.open(mark)
        while left > 0:
            mic.check_alive(mic.inlet.received, START_S)
            speaker.check_alive(speaker.outlet.calls, START_S)
            parts.append(mic.take())
            if begun:
                first = round(begun[0] * SAMPLE_RATE / mic.rate + latency_s * SAMPLE_RATE)
                left = first + wanted - sum(len(part) for part in parts)
            tell(max(left, 0) / SAMPLE_RATE)
            pause()
    finally:
        mic.close()
        speaker.close()
        parts.append(mic.take())
        recorded = np.concatenate(parts)[first : first + wanted]
        if first and len(recorded):
            keep(recorded)
    lost = {"samples lost": mic.inlet.lost, "overruns": mic.inlet.flags, "underruns": speaker.flags}
    holes = ", ".join(f"{count} {what}" for what, count in lost.items() if count)
    return recorded, holes


def _holding(output: Named, samples: Samples, latency_s: float = STREAM_LATENCY_S) -> OutputPort:
    """An output that holds all samples (n,) and plays them as soon as it is opened."""
    port = output_port(output, samples.size, latency_s=latency_s)
    port.outlet.ring.write(port.convert(samples.astype(np.float32), last=True))
    port.outlet.draining = True
    return port


def play_through(output: Named, source: Source, samples: Samples) -> tuple[Samples, Samples, int]:
    """Play samples (n,) at 16 kHz while a live source runs, until two seconds after them.

    Returns its microphone and reference (m,), and how many samples were lost. Raises as play_and_record.
    """
    speaker = _holding(output, samples)
    wanted = samples.size + 2 * SAMPLE_RATE
    blocks: list[Block] = []
    try:
        with source:
            for block in source:
                if not blocks:
                    speaker.open()
                blocks.append(block)
                speaker.check_alive(speaker.outlet.calls, START_S)
                wanted -= block.ref.size
                if wanted <= 0:
                    break
    finally:
        speaker.close()
    mic, ref = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("mic", "ref"))
    return mic, ref, sum(block.lost for block in blocks)


@dataclass(frozen=True)
class Channel:
    """What one microphone of an array delivered.

    number: of the device's channel. level_db, floor_db, peak_db: of full scale; the floor is the level that it
    exceeds nine tenths of the time. coherence: with the first microphone that is not silent, mean over 200 Hz to 4 kHz, 0
    to 1; 0 of silence.
    """

    number: int
    level_db: float
    floor_db: float
    peak_db: float
    coherence: float


@dataclass(frozen=True)
class Trial:
    """What one input delivered.

    rate: Hz, at which it was opened. pace: samples that came per second of this machine's clock, divided by that rate; 1 is right, good
    to some 0.1 %. level_db, peak_db: of full scale, -120 for digital silence. overruns: callbacks that PortAudio flagged with
    an overrun. channels: of an array, the result of each microphone.
    """

    rate: int
    pace: float
    level_db: float
    peak_db: float
    overruns: int
    channels: tuple[Channel, ...] = ()


def listen(ports: Sequence[InputPort], seconds: float = 3.0) -> list[Trial]:
    """Open the inputs, listen until each has run for so long, and close them.

    Raises DeviceError where one cannot be opened or stops.
    """
    sound: list[list[np.ndarray]] = [[] for _ in ports]
    steps: list[list[tuple[float, int]]] = [[] for _ in ports]
    try:
        for port in ports:
            port.open()
        while min((step[-1][0] - step[0][0] if step else 0.0) for step in steps) < seconds:
            for port, parts, step in zip(ports, sound, steps):
                now, received = clock(), port.inlet.received
                port.check_alive(received, START_S)
                if received > (step[-1][1] if step else 0):
                    step.append((now, received))
                parts.append(port.take())
            pause()
    finally:
        for port in ports:
            port.close()
    return [_trial(port, np.concatenate(parts), step) for port, parts, step in zip(ports, sound, steps)]


def _trial(port: InputPort, sound: np.ndarray, steps: Sequence[tuple[float, int]]) -> Trial:
    """The pace is the slope of a line through the counter, without the first half second in which devices settle."""
    times, received = np.array(steps).T
    settled = times > times[0] + 0.5
    slope = np.polyfit(times[settled] - times[0], received[settled], 1)[0]
    level = float(decibels(float(np.mean(np.square(sound, dtype=np.float64)))))
    each = channels(sound, port.wanted) if port.wanted and sound.ndim > 1 else ()
    return Trial(port.rate, float(slope / port.rate), level, _peak_db(sound), port.inlet.flags, each)


def _peak_db(sound: np.ndarray) -> float:
    return float(decibels(float(np.max(np.square(sound), initial=0.0))))


def channels(sound: np.ndarray, numbers: Sequence[int]) -> tuple[Channel, ...]:
    """What each microphone delivered, of sound (n, microphones); numbers: of the device's channels."""
    hop = SAMPLE_RATE // 50
    power = np.square(sound[: len(sound) // hop * hop], dtype=np.float64).reshape(-1, hop, len(numbers)).mean(axis=1)
    coherence, heard = np.zeros(len(numbers)), np.ptp(sound, axis=0) > 0.0
    if heard.any():  # of a channel that stands still no coherence can be told
        first = sound[:, heard.argmax()]
        hz, alike = signal.coherence(first[:, None], sound[:, heard], SAMPLE_RATE, nperseg=512, axis=0)
        inside = (hz >= 200.0) & (hz <= 4000.0)
        coherence[heard] = np.sqrt(alike[inside]).mean(axis=0)
    found = []
    for number, each, one, similar in zip(numbers, power.T, sound.T, coherence):
        level, floor = (float(decibels(float(value))) for value in (each.mean(), np.percentile(each, 10)))
        found.append(Channel(number, level, floor, _peak_db(one), float(similar)))
    return tuple(found)
