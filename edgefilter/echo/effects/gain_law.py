"""How an automatic gain control follows the level that it hears: attack, release, slope, and the level below which it stands still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edgefilter.dsp.frames import block_sums
from edgefilter.types import SAMPLE_RATE, Array, Samples

STEP = SAMPLE_RATE // 40
"""Samples (25 ms) from one value of the gain to the next."""
ATTACKS_S, RELEASES_S = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6), (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
FINER = (0.7, 1.0, 1.4)
NO_HOLD_DB = -200.0
SURE = 40.0
"""Energy of the voice over the fan's variance from which on a step tells its gain."""
MODEL_DB = 0.3
"""By how much any such law is off."""


@dataclass(frozen=True, eq=False)
class GainLaw:
    """A gain that follows a level. curve_db: (k,) the gain at the middle of each step, relative to a constant.

    misfit, plain: weighted mean square of what is left of the measured gains, dB^2, with the law and with a
    constant. measured: how many steps told their gain.
    """

    curve_db: Array
    misfit: float
    plain: float
    measured: int


def follow(level_db: Array, voice: Samples, recording: Samples, weights: Samples) -> GainLaw | None:
    """The law whose gain, driven by the level (k,) in dB of each step, agrees best with that of recording (n,) over voice (n,).

    Both whitened; weights (n,). A feed-forward control in dB with smoothed gain (Giannoulis, Massberg & Reiss 2012, eq.
    7 and 16): it falls with the attack time, rises with the release time, and by slope dB per dB; a feed-back control
    with a linear law is the same with shorter times. None where too little of the voice is heard.
    """
    energy, cross = (block_sums(voice * other * weights, STEP) for other in (voice, recording))
    sure = (energy > SURE) & (cross > 0.05 * energy)
    if sure.sum() < 20:
        return None
    gain_db = 20.0 * np.log10(cross[sure] / energy[sure])
    trust = 1.0 / (75.4 / energy[sure] + MODEL_DB**2)
    trust /= trust.sum()
    middle = float(trust @ gain_db)
    loud = np.quantile(level_db[sure], (0.1, 0.3, 0.6, 0.9))

    def best(*choices: Array) -> tuple[float, Array, tuple[float, ...]]:
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*choices)])
        moved = _driven(level_db, *grid)
        seen = moved[sure] - trust @ moved[sure]
        power = np.einsum("k,km,km->m", trust, seen, seen)
        slope = np.clip(((trust * (gain_db - middle)) @ seen) / (power + 1e-9), 0.0, 1.0)
        left = np.einsum("k,km->m", trust, (gain_db[:, None] - middle - slope * seen) ** 2)
        i = int(np.argmin(left))
        return float(left[i]), slope[i] * (moved[:, i] - trust @ moved[sure, i]) + middle, tuple(grid[:, i])

    found = best(
        np.array(ATTACKS_S), np.array(RELEASES_S), np.array([NO_HOLD_DB, loud[0] - 10.0, loud[0], loud[1]]), -loud[1:]
    )
    attack, release, hold, start = found[2]
    around, starts = np.array(FINER), start + np.arange(-6.0, 6.1, 3.0)
    finer = best(attack * around, release * around, hold + np.array([-5.0, 0.0, 5.0]), starts)
    misfit, curve, _ = min(found, finer, key=lambda law: law[0])
    return GainLaw(curve, misfit, float(trust @ (gain_db - middle) ** 2), int(sure.sum()))


def _driven(level_db: Array, attack_s: Array, release_s: Array, hold_db: Array, start_db: Array) -> Array:
    """Gain in dB, for a slope of 1, of m controls that follow level (k,), (k, m)."""
    fall, rise = (1.0 - np.exp(-STEP / SAMPLE_RATE / seconds) for seconds in (attack_s, release_s))
    gain, curve = start_db.astype(float), np.empty((level_db.size, start_db.size))
    for i, level in enumerate(level_db.tolist()):
        missing = -level - gain
        gain = gain + np.where(missing < 0.0, fall, rise) * missing * (level > hold_db)
        curve[i] = gain
    return curve
