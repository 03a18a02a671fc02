"""Microphones that process their sound, and noises beside a conversation, on none of which the filter was tuned.

They are simulated in another way than those of the training (export/simulate): the gains are of bands in place of a short-time
spectrum, the hum is a rectifier's, and motors follow gestures in place of the voice's envelope.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import signal

from bench.simulate.simulated_robot import RATE, Array, Rng

FRAME = 128
"""8 ms: gains are computed once for each frame."""
EDGES_HZ = (250, 500, 1000, 2000, 3000, 4500, 6000)
"""Between the bands of the noise suppression, about two critical bands each."""
TAPS = 255
LATE = TAPS // 2
"""Samples by which a device that processes is late: the delay of its filters."""
FLOOR_S = 1.5
"""The noise is the least of a band's power over this: longer than a word."""
RECORDED = ("sweep_mic", "fan_only", "mic")
"""What one microphone records, calibration and conversation."""

Signals = dict[str, Array]


@dataclass(frozen=True)
class Processing:
    """A device that suppresses noise and controls its gain.

    depth_db: greatest attenuation of noise. ratio: fall of the gain, dB, for each dB of level above mean_db, and rise below it.
    """

    depth_db: float
    ratio: float
    mean_db: float

    @classmethod
    def draw(cls, rng: Rng, mic: Array) -> Processing:
        return cls(rng.uniform(8, 15), rng.uniform(0.4, 0.8), 10 * math.log10(np.mean(np.square(mic, dtype=float))))

    def whole(self, mic: Array, *parts: Array) -> list[Array]:
        """Process a whole recording (n,) from a fresh state and take the device's delay out; the result, and `parts` under the same gains."""
        sounds = [np.pad(x, (0, LATE)) for x in (mic, *parts)]
        return [x[LATE:] for x in Stream(self)(*sounds)]


class Stream:
    """One run of a `Processing` device, block by block: a gain for each band suppresses noise, one for all bands controls the level."""

    def __init__(self, device: Processing) -> None:
        self._device = device
        lows = [np.zeros(TAPS), *(signal.firwin(TAPS, hz, fs=RATE) for hz in EDGES_HZ), np.eye(1, TAPS, LATE)[0]]
        self._bands = np.diff(lows, axis=0)
        self._before: Array = np.zeros(0)
        self._power = self._level = self._suppressed = self._gain = self._floor = np.zeros(0)

    def __call__(self, mic: Array, *parts: Array) -> list[Array]:
        """Process a block (n,): the output, and `parts`, which mic is the sum of, under the same gains; all are late by LATE samples.

        n is a multiple of FRAME, except in the last block.
        """
        sounds = np.stack([np.pad(x.astype(float), (0, -x.size % FRAME)) for x in (mic, *parts)])
        if not self._before.size:
            self._before = np.zeros((len(sounds), TAPS - 1))
        sounds = np.concatenate((self._before, sounds), axis=1)
        self._before = sounds[:, 1 - TAPS :]
        bands = signal.oaconvolve(sounds[:, None], self._bands[None], "valid", axes=2)  # (parts, bands, n)
        self._power, power = _smooth(_power(bands[0]), 0.03, self._power)
        frames = round(FLOOR_S * RATE / FRAME) - 1
        past = np.concatenate(
            (self._floor if self._floor.size else np.repeat(power[:, :1], frames, axis=1), power), axis=1
        )
        self._floor = past[:, -frames:]
        noise = 1.5 * np.lib.stride_tricks.sliding_window_view(past, frames + 1, axis=1).min(axis=2)
        suppression = np.sqrt(np.maximum(1 - noise / power, 10 ** (-self._device.depth_db / 10)))
        self._suppressed, suppression = _smooth(suppression, 0.01, self._suppressed)
        self._level, level = _smooth(_power(sounds[:1, TAPS - 1 :]), 0.1, self._level)
        above_db = 10 * np.log10(level) - self._device.mean_db
        gains = suppression * 10 ** (np.clip(-self._device.ratio * above_db, -9, 3) / 20)
        gains = np.concatenate((self._gain if self._gain.size else gains[:, :1], gains), axis=1)
        self._gain = gains[:, -1:]
        at = np.arange(bands.shape[2]) / FRAME
        each = np.stack([np.interp(at, np.arange(band.size), band) for band in gains])
        return [np.sum(each * one, axis=0)[: mic.size] for one in bands]


def processed(rng: Rng, signals: Signals, voice: Array) -> Signals:
    """The signals as a device that processes its sound delivers them; the human's part, too, is that after processing."""
    device = Processing.draw(rng, signals["mic"])
    found = {name: device.whole(signals[name])[0] for name in ("sweep_mic", "fan_only")}
    heard = device.whole(*(signals[name] for name in ("mic", "clean", "fan")))
    found |= dict(zip(("mic", "clean", "fan"), heard, strict=True))
    full = max(1.0, max(np.abs(x).max() for x in found.values()) / 0.95)
    return signals | {name: x / full for name, x in found.items()}


def _power(x: Array) -> Array:
    """Mean square of each frame of x (..., n), (..., frames)."""
    return np.mean(x.reshape(*x.shape[:-1], -1, FRAME) ** 2, axis=-1) + 1e-12


def _smooth(values: Array, seconds: float, before: Array) -> tuple[Array, Array]:
    """Smooth values (rows, frames) over `seconds`, from the last smoothed value `before`, (rows, 1), on, or from the first if that is (0,).

    Returns the last smoothed value and all of them.
    """
    kept = math.exp(-FRAME / RATE / seconds)
    start = kept * (before if before.size else values[:, :1])
    found = signal.lfilter([1 - kept], [1, -kept], values, axis=1, zi=start)[0]
    return found[:, -1:], found


def hum(rng: Rng, signals: Signals, voice: Array) -> Signals:
    """A constant offset, and the hum of a rectifier whose mains wander, -55 to -35 dB of full scale each."""
    offset, level = (rng.choice([-1, 1]) * 10 ** (rng.uniform(-55, -35) / 20) for _ in range(2))
    mains_hz, clipped = rng.choice([50.0, 60.0]), rng.uniform(0.3, 0.9)
    found = dict(signals)
    for name in RECORDED:
        wander = 0.02 * np.cumsum(rng.standard_normal(signals[name].size)) / math.sqrt(RATE)  # Hz, after a second
        wave = np.clip(np.sin(2 * np.pi * (np.cumsum(mains_hz + wander) / RATE + rng.random())), -clipped, 1)
        found[name] = signals[name] + offset + level * (wave - wave.mean()) / wave.std()
    return found


def motors(rng: Rng, signals: Signals, voice: Array) -> Signals:
    """Servos that make gestures while the voice (n,) sounds, 14 to 28 dB below it where they move: as loud as the human, or twice."""
    speed, at = np.zeros(voice.size), 0
    _, power = _smooth(_power(np.pad(voice, (0, -voice.size % FRAME))[None]), 0.1, np.zeros(0))
    loud = np.interp(np.arange(voice.size), FRAME * (np.arange(power.size) + 0.5), power[0])
    while at < voice.size:
        size = int(rng.uniform(0.2, 0.8) * RATE)
        if loud[at] > 1e-2 * loud.max():
            speed[at : at + size] = (rng.uniform(0.3, 1) * np.hanning(size))[: voice.size - at]
        at += int(rng.uniform(1.0, 1.5) * size)
    turned = 2 * np.pi * np.cumsum(rng.uniform(200, 900) * speed) / RATE
    gears = sum(np.sin(tooth * turned + rng.uniform(0, 6)) / tooth for tooth in (1, 2, 3, 5, 8))
    brushes = signal.lfilter(*signal.butter(1, (400, 3000), "bandpass", fs=RATE), rng.standard_normal(voice.size))
    moved = speed * (gears + rng.uniform(0.5, 2) * brushes)
    echo = signals["mic"] - signals["clean"] - signals["fan"]
    rms = math.sqrt(np.mean(echo[loud > 1e-2 * loud.max()] ** 2)) * 10 ** (-rng.uniform(14, 28) / 20)
    moved *= rms / max(math.sqrt(np.mean(moved[speed > 0] ** 2)), 1e-9) if speed.any() else 0
    return signals | {name: signals[name] + moved for name in ("mic", "fan")}


MICROPHONES: dict[str, Callable[[Rng, Signals, Array], Signals]] = {
    "processed": processed,
    "hum": hum,
    "motors": motors,
}
"""By name: with a scene's signals and the voice that is played (n,), the signals that such a robot has."""
