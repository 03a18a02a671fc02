"""Whether the fan itself is another than at the calibration, once the robot's voice is taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edgefilter.echo.effect import find
from edgefilter.judge import Judge
from edgefilter.leftover import Leftover, inspect
from edgefilter.prepare import Prepared
from edgefilter.search import Found, Trial
from edgefilter.types import Samples

NAME = "fan_noise"
LEAST_CHANGE_DB = 1.0
"""By less than this a fan differs from day to day."""
STEADY_DB = 3.0
"""The loud and the quiet tenth of a second of a fan, whitened, differ by less than this; a talker's by much more."""


def look_at_fan(prepared: Prepared, found: Found) -> tuple[Found, Leftover]:
    """The search's outcome with the final residual judged against the fan as it is now, and with fan_noise where that is another.

    A microphone gain in the model is taken out of the residual first: the fan passed through it.
    """
    measurement, model = prepared.measurement, found.model
    gain = microphone_gain(found, measurement.recording.size)
    residual = (measurement.recording - found.final.prediction) / gain
    left = inspect(prepared, residual)
    final = found.final
    if not np.array_equal(gain, np.ones_like(gain)):
        final = _judged(prepared, final.prediction, gain)
    effect = find(NAME)
    values = effect.fit(replace(measurement, recording=measurement.recording / gain), model)
    heard = np.isfinite(left.quiet_mean_db)
    change = max(float(values["change_db"]), left.quiet_mean_db) if heard else float(values["change_db"])
    steady = not left.mains_hz and left.swing_db < STEADY_DB and (not heard or abs(left.quiet_mean_db) > 0.5 * LEAST_CHANGE_DB)
    if abs(change) < LEAST_CHANGE_DB or not steady or NAME in dict(model.effects):
        return replace(found, final=final), left
    now = replace(prepared, measurement=replace(measurement, noise_psd=effect.noise_psd(values, measurement.noise_psd)))
    after = _judged(now, final.prediction, gain)
    if (after.silent_db > 0.5 * final.silent_db) if heard else (after.excess_db > LEAST_CHANGE_DB):
        return replace(found, final=final), left
    changed = model.with_effect(NAME, values)
    step = Trial(NAME, values, changed, after, final.level_db - after.level_db, change)
    return replace(found, model=changed, final=after, steps=(*found.steps, step)), inspect(now, residual)


def microphone_gain(found: Found, size: int) -> Samples:
    """(size,) the gain that the model's automatic gain control gives the microphone at each moment; ones without one."""
    values = dict(found.model.effects).get("mic_agc")
    ones = np.ones(size, np.float32)
    return ones if values is None else find("mic_agc").apply(ones, values, 16000)


def _judged(prepared: Prepared, prediction: Samples, gain: Samples):
    """The verdict on an already corrected prediction, with the gain taken out of the residual."""
    measurement = prepared.measurement
    flat = replace(prepared, measurement=replace(measurement, recording=(measurement.recording - prediction) / gain))
    return replace(Judge(flat).judge(np.zeros_like(prediction), correct=False), prediction=prediction)
