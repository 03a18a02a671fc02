"""Steady tones in a noise, and the frequency of the mains (50 or 60 Hz) whose harmonics they may be."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from edgefilter.dsp.psd import frequencies, periodograms
from edgefilter.types import Array, Samples

SECOND = 16384
"""Samples, about a second, that transform fast."""
LINE_OVER_FLOOR = 10.0
"""Times the median of its surroundings that a bin of a long spectrum must reach to be a tone (noise alone reaches 3 in
1000 means of 30)."""


def tones(residual: Samples, psd: Samples) -> tuple[Array, float, float]:
    """Tones in Hz, loudest first, the mains frequency they belong to (0: none), their share of the power over the fan."""
    if residual.size < 2 * SECOND:
        return np.zeros(0), 0.0, 0.0
    power = np.median(periodograms(residual, SECOND), axis=0)
    hz = frequencies(power.size)
    floor = median_filter(power, 81, mode="nearest")
    expected = np.interp(hz, frequencies(psd.size), psd) * np.log(2)
    peak = power > LINE_OVER_FLOOR * np.maximum(floor, expected)
    peak &= power >= np.maximum(np.roll(power, 1), np.roll(power, -1))
    peak[:20] = False
    at = np.flatnonzero(peak)
    at = at[np.argsort(-power[at])][:40]
    if not at.size:
        return np.zeros(0), 0.0, 0.0
    over = np.maximum(power - expected, 0.0)
    near = np.unique(np.minimum(at[:, None] + np.arange(-2, 3), power.size - 1))
    share = float(over[near].sum()) / max(float(over.sum()), 1e-30)
    mains = 0.0
    for grid in (50.0, 60.0):
        on_grid = np.abs(hz[at] / grid - np.round(hz[at] / grid)) * grid < 0.8
        if power[at][on_grid].sum() > 0.8 * power[at].sum() and on_grid.sum() >= 2:
            mains = grid
    return hz[at], mains, share
