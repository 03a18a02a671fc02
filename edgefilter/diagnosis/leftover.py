"""What is left of a recording when the robot's voice is taken out: the fan, tones, somebody talking, or something unknown, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.score import Scorer
from edgefilter.diagnosis.trials import Found
from edgefilter.dsp.frames import block_power, blocks, decibels
from edgefilter.dsp.psd import frequencies, periodograms
from edgefilter.echo.measurement import whiten
from edgefilter.types import SAMPLE_RATE, Array, Samples

LINE_FFT = 16384
LINE_OVER_FLOOR = 10.0
"""Times the median of its surroundings that a bin of a long spectrum must reach to be a tone (noise alone reaches 3 in
1000 means of 30)."""
BLOCK = SAMPLE_RATE // 10


@dataclass(frozen=True, eq=False)
class Leftover:
    """Tones that are left. tones_hz: (k,) of the strongest, loudest first.

    mains_hz: 50 or 60 where most of their power lies on its multiples, else 0. tone_share: of the residual's power over
    the fan, in tones. quiet_db: excess while the robot is silent, its median over blocks of 0.1 s; swing_db: by how
    much those blocks differ (90 % to 10 % quantile) beyond what noise does. level_slope: by how many dB the excess
    grows per dB of the robot's level.
    """

    tones_hz: Array
    mains_hz: float
    tone_share: float
    quiet_db: float
    quiet_mean_db: float
    swing_db: float


def inspect(prepared: Prepared, residual: Samples) -> Leftover:
    """Look at what a model leaves of a prepared recording, residual (n,)."""
    psd = prepared.noise_psd
    tones, mains, share = _tones(residual, psd)
    quiet = prepared.usable & ~prepared.active
    white = whiten(residual, psd)
    power = block_power(white, BLOCK)[blocks(quiet, BLOCK).all(axis=1)]
    if power.size < 5:
        return Leftover(tones, mains, share, float("nan"), float("nan"), 0.0)
    low, middle, high = decibels(np.quantile(power, (0.1, 0.5, 0.9)))
    return Leftover(tones, mains, share, float(middle), float(decibels(power.mean())), float(high - low))


def _tones(residual: Samples, psd: Samples) -> tuple[Array, float, float]:
    """Frequencies of tones, loudest first, the mains frequency they belong to (0: none), and their share of the power over the fan."""
    if residual.size < 2 * LINE_FFT:
        return np.zeros(0), 0.0, 0.0
    power = np.median(periodograms(residual, LINE_FFT), axis=0)
    hz = frequencies(power.size)
    floor = median_filter(power, 81, mode="nearest")
    expected = np.interp(hz, frequencies(psd.size), psd) * np.log(2)
    peak = (
        (power > LINE_OVER_FLOOR * floor)
        & (power > LINE_OVER_FLOOR * expected)
        & (power >= np.maximum(np.roll(power, 1), np.roll(power, -1)))
    )
    peak[:20] = False
    at = np.flatnonzero(peak)
    at = at[np.argsort(-power[at])][:40]
    if not at.size:
        return np.zeros(0), 0.0, 0.0
    over = float(np.maximum(power - expected, 0.0).sum())
    near = np.unique(np.clip(at[:, None] + np.arange(-2, 3), 0, power.size - 1))
    share = float(np.maximum(power - expected, 0.0)[near].sum()) / max(over, 1e-30)
    mains = 0.0
    for grid in (50.0, 60.0):
        off = np.abs(hz[at] / grid - np.round(hz[at] / grid)) * grid
        if power[at][off < 0.8].sum() > 0.8 * power[at].sum() and (off < 0.8).sum() >= 2:
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
    final = found.final
    active = final.active_db - max(left.quiet_mean_db if np.isfinite(left.quiet_mean_db) else 0.0, 0.0)
    if np.isfinite(left.quiet_db) and left.quiet_mean_db > 1.0 and not words:
        words.append(
            "sound of its own while the robot is silent" + (", coming and going" if left.swing_db > 6.0 else "")
        )
    if active > 1.0:
        weights = 10 * np.log10(np.maximum(final.cells, 1e-3)).mean(axis=0)
        low, high = Scorer(found.prepared).band_hz[int(np.argmax(weights))]
        words.append(f"a residual that follows the robot's voice, strongest around {low:.0f} to {high:.0f} Hz")
    if not words:
        words.append("a residual spread over the whole recording")
    return "what no effect of the catalogue explains: " + "; ".join(words)
