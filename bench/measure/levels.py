"""Levels over time."""

from __future__ import annotations

import numpy as np
from scipy import signal

from edgefilter.types import SAMPLE_RATE, Samples

FRAME = SAMPLE_RATE // 50
"""20 ms."""
RUMBLE = signal.butter(4, 120.0, "high", fs=SAMPLE_RATE, output="sos")


def frame_power(x: Samples, frame: int = FRAME) -> np.ndarray:
    """Mean square of each whole frame of x (n,), (n // frame,) float64."""
    return np.mean(x[: x.size // frame * frame].reshape(-1, frame).astype(np.float64) ** 2, axis=1)


def above_rumble(x: Samples) -> Samples:
    """The part of x (n,) above 120 Hz, where no voice is lost: without a profile the filter lowers what lies below 90 Hz."""
    return signal.sosfilt(RUMBLE, x).astype(np.float32)
