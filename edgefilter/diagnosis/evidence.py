"""One sentence for each finding: what in the recording speaks for it; and what is left, in words."""

from __future__ import annotations

import numpy as np

from edgefilter.diagnosis.leftover import Leftover
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effects.catalogue import find
from edgefilter.types import SAMPLE_RATE


def sentence(step: Trial) -> str:
    """What in the data speaks for the effect, with its figures."""
    return find(step.name).sentence(step.values) or f"with {step.name} the held-out residual falls by {step.gain_db:.2f} dB"


def left_in_words(prepared: Prepared, found: Found, left: Leftover, remaining_db: float, floor_db: float) -> str:
    """What is in the residual that no finding explains; empty where it is the fan."""
    spans = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in prepared.human)
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
        words.append("sound of its own while the robot is silent" + (", coming and going" if left.swing_db > 6.0 else ""))
    if active > 1.0:
        weights = 10 * np.log10(np.maximum(final.cells, 1e-3)).mean(axis=0)
        top = int(np.argmax(weights))
        words.append(f"a residual that follows the robot's voice, strongest around {_band(top, final.cells.shape[1])}")
        words += [find(name).noise_words for name, _ in found.model.effects if find(name).noise_words]
    if not words:
        words.append("a residual spread over the whole recording")
    return f"{remaining_db:.1f} dB over the noise floor that no effect of the catalogue explains: " + "; ".join(words)


def _band(index: int, count: int) -> str:
    edges = np.geomspace(4, 250, count + 1) * SAMPLE_RATE / 512
    return f"{edges[index]:.0f} to {edges[index + 1]:.0f} Hz"
