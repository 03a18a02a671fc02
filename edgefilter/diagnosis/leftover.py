"""What is left of a recording without the robot's voice: the fan, tones, talk, or something unknown, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from edgefilter.diagnosis.channels import SECOND
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.score import Scorer
from edgefilter.diagnosis.trials import Found
from edgefilter.dsp.frames import block_power, blocks, decibels
from edgefilter.dsp.psd import frequencies, periodograms
from edgefilter.echo.measurement import whiten
from edgefilter.types import SAMPLE_RATE, Array, Samples

LINE_OVER_FLOOR = 10.0
"""Times the median of its surroundings that a bin of a long spectrum must reach to be a tone (noise alone reaches 3 in
1000 means of 30)."""
BLOCK = SAMPLE_RATE // 10


@dataclass(frozen=True, eq=False)
class Leftover:
    """Tones that are left, and the robot's silences.

    tones_hz: (k,) of the strongest, loudest first. mains_hz: 50 or 60 where most of their power lies on its multiples,
    else 0. tone_share: of the residual's power over the fan, in tones. quiet_mean_db: mean excess while the robot is
    silent, nan where it never is. swing_db: by how much blocks of 0.1 s differ then (90 % to 10 % quantile).
    """

    tones_hz: Array
    mains_hz: float
    tone_share: float
    quiet_mean_db: float
    swing_db: float


def inspect(prepared: Prepared, residual: Samples) -> Leftover:
    """Look at what a model leaves of a prepared recording, residual (n,)."""
    psd = prepared.noise_psd
    tones = _tones(residual, psd)
    quiet = blocks(prepared.usable & ~prepared.active, BLOCK).all(axis=1)
    power = block_power(whiten(residual, psd), BLOCK)[quiet]
    if power.size < 5:
        return Leftover(*tones, float("nan"), 0.0)
    low, high = decibels(np.quantile(power, (0.1, 0.9)))
    return Leftover(*tones, float(decibels(power.mean())), float(high - low))


def _tones(residual: Samples, psd: Samples) -> tuple[Array, float, float]:
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


def left_in_words(found: Found, left: Leftover, remaining_db: float, floor_db: float) -> str:
    """What is in the residual that no finding explains; empty where it is the fan."""
    spans = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in found.prepared.human)
    talk = f"somebody talks at {spans}, left out of all figures" if spans else ""
    if remaining_db < floor_db:
        return talk
    words = [talk] if talk else []
    if left.mains_hz and left.tone_share > 0.3:
        words.append(f"tones at multiples of {left.mains_hz:.0f} Hz, also while the robot is silent")
    elif left.tone_share > 0.5:
        words.append("tones at " + ", ".join(f"{hz:.0f}" for hz in left.tones_hz[:4]) + " Hz")
    quiet_db = left.quiet_mean_db if np.isfinite(left.quiet_mean_db) else 0.0
    if quiet_db > 1.0 and not words:
        swings = ", coming and going" if left.swing_db > 6.0 else ""
        words.append(f"sound of its own while the robot is silent{swings}")
    if found.final.active_db - max(quiet_db, 0.0) > 1.0:
        weights = 10 * np.log10(np.maximum(found.final.cells, 1e-3)).mean(axis=0)
        low, high = Scorer(found.prepared).band_hz[int(np.argmax(weights))]
        words.append(f"a residual that follows the robot's voice, strongest around {low:.0f} to {high:.0f} Hz")
    return "what no effect of the catalogue explains: " + "; ".join(
        words or ["a residual spread over the whole recording"]
    )
