"""Gains and limits that depend on the level: compressor, automatic gain control, clipping, a bending amplifier."""

from __future__ import annotations

import math

import numpy as np
from scipy import signal

from bench.simulate.simulated_robot import RATE, Array

STEP_MS = 1
"""Time step of the gain computers."""


def levels_db(x: Array, step_ms: int) -> Array:
    """(m,) RMS level in dBFS of steps of so many ms."""
    step = RATE * step_ms // 1000
    blocks = np.pad(x, (0, -x.size % step)).reshape(-1, step)
    return 10 * np.log10(np.mean(blocks**2, axis=1) + 1e-10)


def gain_curve(gain_db: Array, step_ms: int, n: int) -> Array:
    """(n,) amplitude gain, interpolated in dB between the ends of the steps."""
    ends = (np.arange(gain_db.size) + 1) * (RATE * step_ms // 1000)
    return 10 ** (np.interp(np.arange(n), ends, gain_db) / 20)


def smooth(x: Array, rise_ms: float, fall_ms: float, step_ms: int) -> Array:
    """X (m,) followed by a first-order lag that rises with one time constant and falls with another."""
    rise, fall = (1.0 - math.exp(-step_ms / constant) for constant in (rise_ms, fall_ms))
    out, state = [], float(x[0])
    for value in x.tolist():
        state += (rise if value > state else fall) * (value - state)
        out.append(state)
    return np.array(out)


def compressor_gain_db(
    x: Array, threshold_db: float, ratio: float, knee_db: float, attack_ms: float, release_ms: float
) -> Array:
    """(m,) gain per ms of a feed-forward compressor (Giannoulis, Massberg & Reiss 2012, eq. (4) and (17))."""
    over = levels_db(x, STEP_MS) - threshold_db
    bend = np.clip(over + knee_db / 2, 0, knee_db) ** 2 / (2 * max(knee_db, 1e-6))
    reduction = (1.0 - 1.0 / ratio) * np.where(over > knee_db / 2, over, bend)
    return -smooth(reduction, attack_ms, release_ms, STEP_MS)


def agc_gain_db(
    mic: Array,
    slope: float,
    target_db: float,
    attack_ms: float,
    release_ms: float,
    limit_db: float,
    hold_db: float,
    step_ms: int = 5,
) -> Array:
    """(m,) gain of a feedback loop that steers the output's level towards target_db.

    slope 0..1: how much of the deviation it takes away. Falls with attack_ms, rises with release_ms, within +-limit_db;
    stands still while the input is below hold_db.
    """
    fast, slow = (1.0 - math.exp(-step_ms / constant) for constant in (attack_ms, release_ms))
    loop = slope / max(1.0 - slope, 0.05)
    gain, out = 0.0, []
    for level in levels_db(mic, step_ms).tolist():
        if level > hold_db:
            wanted = min(max(loop * (target_db - level - gain), -limit_db), limit_db)
            gain += (fast if wanted < gain else slow) * (wanted - gain)
        out.append(gain)
    return np.array(out)


def soft_clip(x: Array, low: float, high: float, hardness: float) -> Array:
    """An amplifier that saturates towards high and -low, x / (1 + |x/limit|^h)^(1/h), at four times the rate."""
    up = signal.resample_poly(x, 4, 1)
    ratio = np.abs(up) / np.where(up > 0, high, low)
    return signal.resample_poly(up / (1.0 + ratio**hardness) ** (1.0 / hardness), 1, 4)[: x.size]
