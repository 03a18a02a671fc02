"""Levels over time."""

from __future__ import annotations

import numpy as np

from edgefilter.types import SAMPLE_RATE, Samples

FRAME = SAMPLE_RATE // 50
"""20 ms."""


def frame_power(x: Samples, frame: int = FRAME) -> np.ndarray:
    """Mean square of each whole frame of x (n,), (n // frame,) float64."""
    return np.mean(x[: x.size // frame * frame].reshape(-1, frame).astype(np.float64) ** 2, axis=1)
