"""Up to four microphones that hear a robot, a fan and a human: what tests of arrays share."""

from __future__ import annotations

import functools

import numpy as np

from edgefilter import calibrate, generate_sweep
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE as RATE

PATHS = [0.3 * np.eye(1, 900, 300 + at)[0] + 0.1 * np.eye(1, 900, 500 - 3 * at)[0] for at in range(4)]


def noise(n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def fan(n: int, microphones: int, seed: int) -> np.ndarray:
    """(n, microphones): one source with a delay a microphone, and a little of each microphone's own."""
    source = noise(n + 10, seed)
    return np.stack([source[at : at + n] + 0.1 * noise(n, seed + 10 + at) for at in range(microphones)], axis=1)


@functools.cache
def calibration(microphones: int) -> Profile:
    sweep = generate_sweep()
    heard = np.stack([np.convolve(sweep, path)[: sweep.size] for path in PATHS[:microphones]], axis=1)
    heard = heard + 1e-3 * fan(sweep.size, microphones, 3)
    return calibrate(sweep, heard.astype(np.float32), (1e-3 * fan(64000, microphones, 4)).astype(np.float32))


@functools.cache
def talk(microphones: int = 3, seconds: float = 6.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Microphones (n, m), reference (n,), and the human in the first microphone (n,), who talks from 3 to 5 s."""
    n = round(seconds * RATE)
    syllables = np.repeat(np.abs(noise(n // 1600 + 1, 6)), 1600)[:n]
    ref = 0.1 * noise(n, 5) * syllables
    human = np.zeros(n)
    human[3 * RATE : 5 * RATE] = 0.02 * noise(2 * RATE, 7) * np.repeat(np.abs(noise(20, 12)), 1600)
    mic = np.stack(
        [np.convolve(ref, path)[:n] + np.roll(human, -2 * at) for at, path in enumerate(PATHS[:microphones])], 1
    )
    mic = mic + 2e-3 * fan(n, microphones, 8)
    return mic.astype(np.float32), ref.astype(np.float32), human.astype(np.float32)
