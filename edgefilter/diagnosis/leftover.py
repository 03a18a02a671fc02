"""What is left of a recording without the robot's voice: the fan, tones, talk, or something unknown, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edgefilter.diagnosis.straightened import bands
from edgefilter.diagnosis.trials import Found
from edgefilter.dsp.frames import block_power, blocks, decibels
from edgefilter.dsp.tones import tones
from edgefilter.echo.measurement import whiten
from edgefilter.types import SAMPLE_RATE, Array


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


def leftover(found: Found) -> Leftover:
    """Look at what the model that was found leaves; a gain of the microphone, which the fan passed as well, is taken out."""
    prepared, heard = found.in_noise, found.in_noise.measurement.recording
    residual, psd = (heard - found.final.prediction) / found.model.microphone_gain(heard.size), prepared.noise_psd
    strongest = tones(residual, psd)
    block = SAMPLE_RATE // 10
    quiet = blocks(prepared.usable & ~prepared.active, block).all(axis=1)
    power = block_power(whiten(residual, psd), block)[quiet]
    if power.size < 5:
        return Leftover(*strongest, float("nan"), 0.0)
    low, high = decibels(np.quantile(power, (0.1, 0.9)))
    return Leftover(*strongest, float(decibels(power.mean())), float(high - low))


def left_in_words(found: Found, left: Leftover, remaining_db: float, floor_db: float) -> str:
    """What is in the residual that no finding explains; empty where it is the fan."""
    spans = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in found.recording.human)
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
        low, high = bands().hz[int(np.argmax(weights))]
        words.append(f"a residual that follows the robot's voice, strongest around {low:.0f} to {high:.0f} Hz")
    return "what no effect of the catalogue explains: " + "; ".join(
        words or ["a residual spread over the whole recording"]
    )
