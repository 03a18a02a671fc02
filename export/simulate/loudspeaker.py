"""What a loudspeaker and the electronics before it add to the robot's voice, of kinds that no linear path explains."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import signal

from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.compression import Compression
from edgefilter.types import SAMPLE_RATE, Samples

SECOND = 0.4
"""Share of loudspeakers with two kinds of distortion at once."""


def distorted(rng: np.random.Generator, x: Samples, kinds: tuple[str, ...], level_db: float) -> Samples:
    """Add one or two of these kinds of distortion to x (n,), level_db over x.

    What of it is x again, only louder, is taken out first, so that the level says what a canceller cannot reach.
    """
    chosen = [str(rng.choice(kinds))]
    if len(kinds) > 1 and rng.random() < SECOND:
        chosen.append(str(rng.choice(kinds)))
    rms = active_rms(x)
    if rms < 1e-9:
        return x
    added = np.zeros(x.size)
    for kind in chosen:
        part = KINDS[kind](rng, x / rms) * rms - x
        part -= np.dot(part, x) / np.dot(x, x) * x
        added += part / max(active_rms(part), 1e-9)
    return (x + added * 10 ** (level_db / 20) * rms / max(active_rms(added), 1e-9)).astype(np.float32)


def driver(rng: np.random.Generator, x: Samples) -> Samples:
    """A moving coil: force factor and stiffness depend on the displacement d of the membrane.

    Klippel (2006), "Loudspeaker nonlinearities": the sound holds x f(d) with f a bounded function of d; besides there is
    a small memoryless part from the amplifier.
    """
    low_pass = signal.butter(2, rng.uniform(120, 420), fs=SAMPLE_RATE, output="sos")
    displacement = signal.sosfilt(low_pass, x)
    d = 10 ** rng.uniform(-0.3, 0.7) * displacement / max(active_rms(displacement), 1e-9)
    bound = 1.0 / (1.0 + d * d)
    added = x * (rng.uniform(-1, 1) * d * bound - rng.uniform(0, 1) * d * d * bound)
    return x + added + rng.uniform(0, 0.3) * np.tanh(x)


def soft(rng: np.random.Generator, x: Samples) -> Samples:
    """An amplifier that saturates, more on one side than on the other."""
    drive, bias = 10 ** rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5)
    return np.tanh(drive * x + bias) / drive


def hard(rng: np.random.Generator, x: Samples) -> Samples:
    """A clipper at 1 to 3 times the RMS."""
    limit = rng.uniform(1.0, 3.0)
    return np.clip(x, -limit, rng.uniform(0.7, 1.0) * limit)


def crossover(rng: np.random.Generator, x: Samples) -> Samples:
    """A class-B amplifier without enough bias, or a coil that rubs: small signals are lost."""
    dead = rng.uniform(0.02, 0.3)
    return np.sign(x) * np.maximum(np.abs(x) - dead, 0.0)


def compressor(rng: np.random.Generator, x: Samples) -> Samples:
    """A limiter or compressor of a smart amplifier."""
    values = {
        "threshold_db": rng.uniform(-15, 6) - 20.0,
        "ratio": rng.uniform(2, 20),
        "attack_ms": 10 ** rng.uniform(-0.3, 1.5),
        "release_ms": 10 ** rng.uniform(1.3, 2.8),
    }
    effect = find(Compression.name)
    return 10.0 * effect.apply((0.1 * x).astype(np.float32), complete(effect, values), SAMPLE_RATE)


def rattle(rng: np.random.Generator, x: Samples) -> Samples:
    """Loose parts knock where the chassis swings far enough; each knock is a burst of noise, no two alike."""
    b, a = signal.iirpeak(rng.uniform(80, 500), rng.uniform(2, 12), fs=SAMPLE_RATE)
    swing = signal.lfilter(b, a, x)
    limit = rng.uniform(1.0, 2.5) * max(active_rms(swing), 1e-9)
    knocks = np.flatnonzero((swing[1:] > limit) & (swing[:-1] <= limit))
    impulses = np.zeros(x.size)
    impulses[knocks] = rng.uniform(0.3, 1.0, knocks.size)
    decay = np.exp(-np.arange(1600) / (SAMPLE_RATE * rng.uniform(0.002, 0.02)))
    envelope = signal.oaconvolve(impulses, decay)[: x.size]
    low = rng.uniform(300, 2500)
    band = signal.butter(2, (low, min(7500.0, low * rng.uniform(1.5, 4))), "bandpass", fs=SAMPLE_RATE, output="sos")
    return x + envelope * signal.sosfilt(band, rng.standard_normal(x.size))


def codec(rng: np.random.Generator, x: Samples) -> Samples:
    """A lossy codec on the way to the loudspeaker: bands quantised in steps, weak ones lost, the highest cut."""
    size = int(rng.choice((256, 512, 1024)))
    _, _, frames = signal.stft(x, nperseg=size)
    width = int(rng.integers(4, 12))
    edges = np.arange(0, frames.shape[0], width)
    power = np.add.reduceat(np.abs(frames) ** 2, edges, axis=0) / width
    step = np.repeat(rng.uniform(0.5, 2.5) * np.sqrt(power), width, axis=0)[: frames.shape[0]] + 1e-12
    coded = step * (np.round(frames.real / step) + 1j * np.round(frames.imag / step))
    coded[np.arange(frames.shape[0]) * 8000 / (frames.shape[0] - 1) > rng.uniform(3800, 8001)] = 0.0
    return signal.istft(coded, nperseg=size)[1][: x.size]


def multiband(rng: np.random.Generator, x: Samples) -> Samples:
    """Three bands, each through a saturation of its own, as devices with loudness processing have."""
    edges = np.sort(10 ** rng.uniform(math.log10(200), math.log10(5000), 2))
    low = signal.sosfilt(signal.butter(2, edges[0], fs=SAMPLE_RATE, output="sos"), x)
    high = signal.sosfilt(signal.butter(2, edges[1], "high", fs=SAMPLE_RATE, output="sos"), x)
    total = np.zeros(x.size)
    for band in (low, x - low - high, high):
        drive = 10 ** rng.uniform(-0.7, 0.7) / max(active_rms(band), 1e-9)
        total += np.tanh(drive * band) / drive
    return total


def flutter(rng: np.random.Generator, x: Samples) -> Samples:
    """Gains of three bands that wander within syllables: adaptive loudness, an air path that moves."""
    low = signal.sosfilt(signal.butter(1, rng.uniform(300, 900), fs=SAMPLE_RATE, output="sos"), x)
    high = signal.sosfilt(signal.butter(1, rng.uniform(1200, 4000), "high", fs=SAMPLE_RATE, output="sos"), x)
    rate, total = rng.uniform(2, 25), np.zeros(x.size)
    knots = int(x.size / SAMPLE_RATE * rate) + 2
    places = np.arange(x.size) * rate / SAMPLE_RATE
    for band in (low, x - low - high, high):
        total += band * (1.0 + 0.3 * np.interp(places, np.arange(knots), rng.standard_normal(knots)))
    return total


KINDS: dict[str, Callable[[np.random.Generator, Samples], Samples]] = {
    f.__name__: f for f in (driver, soft, hard, crossover, compressor, rattle, codec, multiband, flutter)
}
"""Each takes x (n,) with an active RMS of 1 to what comes out, x included. Only `driver` is near the products that the
canceller hears."""


def active_rms(x: Samples) -> float:
    """RMS over the 20 ms stretches that are within 30 dB of the loudest."""
    power = np.mean(x[: x.size // 320 * 320].reshape(-1, 320).astype(np.float64) ** 2, axis=1)
    loud = power[power > 1e-3 * power.max()] if power.size else power
    return math.sqrt(loud.mean()) if loud.size else 0.0
