"""A path, a sound with syllables, and the canceller run over them."""

from __future__ import annotations

import numpy as np
from scipy import signal

from edgefilter.filter.canceller import Canceller


def path(seed: int = 0, taps: int = 3000) -> np.ndarray:
    """A decaying random path with its direct sound at 32 samples."""
    rng = np.random.default_rng(seed)
    h = 0.03 * rng.standard_normal(taps) * np.exp(-np.arange(taps) / 500)
    h[:32] = 0.0
    h[32] = 0.5
    return h.astype(np.float32)


def speechlike(seconds: float, seed: int = 1) -> np.ndarray:
    """Coloured noise whose level moves at the rate of syllables."""
    rng = np.random.default_rng(seed)
    n = int(seconds * 16000)
    noise = signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))
    level = 0.55 + 0.45 * np.sin(2 * np.pi * 4 * np.arange(n) / 16000 + rng.uniform(0, 6))
    return (0.03 * noise * level).astype(np.float32)


def scene(seconds: float, taps: int = 3000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A path, such a sound, and what a microphone hears of it by that path."""
    h, x = path(taps=taps), speechlike(seconds)
    return h, x, signal.oaconvolve(x, h)[: x.size].astype(np.float32)


def run(canceller: Canceller, mic: np.ndarray, reference: np.ndarray, located: bool = True) -> np.ndarray:
    hops = [slice(at, at + canceller.hop) for at in range(0, mic.size - canceller.hop + 1, canceller.hop)]
    return np.concatenate((mic[:0], *(canceller.step(mic[hop], reference[hop], located).error for hop in hops)))
