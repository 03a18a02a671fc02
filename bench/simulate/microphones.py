"""Microphones that process their sound, and noises beside a conversation, on none of which the filter was tuned.

They are simulated in another way than those of the training (export/simulate): the gains are of bands in place of a short-time
spectrum, the hum is a rectifier's, and motors follow gestures in place of the voice's envelope.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import signal
from scipy.ndimage import minimum_filter1d

from bench.simulate.simulated_robot import RATE, Array, Rng

FRAME = RATE // 100
"""10 ms, of gains."""
EDGES_HZ = (250, 500, 1000, 2000, 3000, 4500, 6000)
"""Between the bands of the noise suppression, about two critical bands each."""
FLOOR_S = 1.5
"""The noise is the least of a band's power over this: longer than a word."""
RECORDED = ("sweep_mic", "fan_only", "mic")
"""What one microphone records, calibration and conversation."""

Signals = dict[str, Array]


def processed(rng: Rng, signals: Signals, voice: Array) -> Signals:
    """A device that suppresses noise and controls its gain; the human is what it makes of the human."""
    depth_db, ratio = rng.uniform(8, 15), rng.uniform(0.4, 0.8)
    mean_db = 10 * math.log10(np.mean(signals["mic"] ** 2))
    found = {name: _processed(depth_db, ratio, mean_db, signals[name])[0] for name in ("sweep_mic", "fan_only")}
    heard = _processed(depth_db, ratio, mean_db, *(signals[name] for name in ("mic", "clean", "fan")))
    found |= dict(zip(("mic", "clean", "fan"), heard, strict=True))
    full = max(1.0, max(np.abs(x).max() for x in found.values()) / 0.95)
    return signals | {name: x / full for name, x in found.items()}


def _processed(depth_db: float, ratio: float, mean_db: float, mic: Array, *parts: Array) -> list[Array]:
    """The microphone and its parts, (n,) each, under the same gains: one of each band against noise, and one of all against the level."""
    lows = [np.zeros(255), *(signal.firwin(255, hz, fs=RATE) for hz in EDGES_HZ), np.eye(1, 255, 127)[0]]
    out = [np.zeros(mic.size) for _ in (mic, *parts)]
    for taps in np.diff(lows, axis=0):
        power = _smooth(_power(signal.oaconvolve(mic, taps, "same")), 0.03)
        frames = round(FLOOR_S * RATE / FRAME)
        noise = 1.5 * minimum_filter1d(power, frames, origin=(frames - 1) // 2)
        gain = _smooth(np.sqrt(np.maximum(1 - noise / power, 10 ** (-depth_db / 10))), 0.01)
        for x, whole in zip((mic, *parts), out, strict=True):
            whole += _each_sample(gain, mic.size) * signal.oaconvolve(x, taps, "same")
    above_db = 10 * np.log10(_smooth(_power(mic), 0.1)) - mean_db
    control = _each_sample(10 ** (np.clip(-ratio * above_db, -9, 3) / 20), mic.size)
    return [control * whole for whole in out]


def _power(x: Array) -> Array:
    """Mean square of each frame of x (n,), the last one filled up, (frames,)."""
    return np.mean(np.pad(x, (0, -x.size % FRAME)).reshape(-1, FRAME) ** 2, axis=1) + 1e-12


def _smooth(values: Array, seconds: float) -> Array:
    kept = math.exp(-FRAME / RATE / seconds)
    return signal.lfilter([1 - kept], [1, -kept], values, zi=[kept * values[0]])[0]


def _each_sample(gains: Array, n: int) -> Array:
    return np.interp(np.arange(n), FRAME * (np.arange(gains.size) + 0.5), gains)


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
    loud = _each_sample(_smooth(_power(voice), 0.1), voice.size)
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
