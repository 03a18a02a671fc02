"""Whether the fan itself is another than at the calibration: before the search, and once the robot's voice is taken out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edgefilter.diagnosis.leftover import Leftover, inspect
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.score import Judge, Verdict
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effect import Values, find
from edgefilter.echo.model import EchoModel
from edgefilter.types import Array, Samples

NAME = "fan_noise"
LEAST_CHANGE_DB = 1.0
"""By less than this a fan differs from day to day."""
STEADY_DB, SPARSE_DB = 1.5, 0.7
"""Whitened by its own spectrum, the loud and the quiet tenth of a second of a fan differ by less than the first, a talker's by much more; and its mean
is no more than the second above its median, that of something that slams now and then is."""
COLOURED_DB, FLAT_DB = 0.7, 2.0
"""A gain behind the microphone changes the fan by less than the first from frequency to frequency, and by less than the second over all while it is steady."""
BAND = 20
"""Bins of 13.3 Hz over which the change is averaged before that is judged."""


def changed_fan(prepared: Prepared, model: EchoModel, base: Verdict) -> tuple[Prepared, Trial] | None:
    """The recording prepared with the fan as the robot's silences have it, and fan_noise as a step; None where it is the calibrated one.

    Only where there are silences and the change has a colour of its own: before the voice is explained, a gain cannot be told from it.
    """
    residual = prepared.measurement.recording - base.prediction
    left = inspect(prepared, residual)
    if not np.isfinite(left.quiet_mean_db) or left.mains_hz:
        return None
    values = find(NAME).fit(prepared.measurement, model)
    most = max(float(values["change_db"]), left.quiet_mean_db)
    if most < LEAST_CHANGE_DB or (_colour_db(values) < COLOURED_DB and most < FLAT_DB):
        return None
    now = _with_fan(prepared, values)
    if not _steady(inspect(now, residual)):
        return None
    after = Judge(now).judge(base.prediction, correct=False)
    if not abs(after.silent_db) < 0.5 * abs(base.silent_db):
        return None
    change = float(values["change_db"])
    return now, Trial(NAME, values, model.with_effect(NAME, values), after, base.level_db - after.level_db, change)


def look_at_fan(found: Found) -> tuple[Found, Leftover]:
    """The search's outcome with the final residual judged against the fan as it is now, and with fan_noise where that is another.

    A microphone gain in the model is taken out of the residual first: the fan passed through it.
    """
    prepared = found.prepared
    measurement, model = prepared.measurement, found.model
    gain = model.microphone_gain(measurement.recording.size)
    residual = (measurement.recording - found.final.prediction) / gain
    left = inspect(prepared, residual)
    final = found.final
    if not np.array_equal(gain, np.ones_like(gain)):
        final = _judged(prepared, found, gain)
    if NAME in dict(model.effects):
        return replace(found, final=final), left
    effect = find(NAME)
    values = effect.fit(replace(measurement, recording=measurement.recording / gain), model)
    heard = np.isfinite(left.quiet_mean_db)
    change = max(float(values["change_db"]), left.quiet_mean_db) if heard else float(values["change_db"])
    if abs(change) < LEAST_CHANGE_DB or left.mains_hz or (heard and abs(left.quiet_mean_db) <= 0.5 * LEAST_CHANGE_DB):
        return replace(found, final=final), left
    now = _with_fan(prepared, values)
    after = _judged(now, found, gain)
    behind = inspect(now, residual)
    if not _steady(behind) or ((after.silent_db > 0.5 * final.silent_db) if heard else (after.excess_db > LEAST_CHANGE_DB)):
        return replace(found, final=final), left
    changed = model.with_effect(NAME, values)
    step = Trial(NAME, values, changed, after, final.level_db - after.level_db, change)
    return replace(found, prepared=now, model=changed, final=after, steps=(*found.steps, step)), behind


def _steady(left: Leftover) -> bool:
    """Whether what is left of the silences, whitened by the new fan's spectrum, is a fan; True where there are no silences."""
    return left.swing_db < STEADY_DB and not left.quiet_mean_db - left.quiet_db > SPARSE_DB


def _colour_db(values: Values) -> float:
    """Standard deviation over frequency of the fan's change, dB."""
    spectrum = np.atleast_1d(np.asarray(values["spectrum_db"], float))
    count = spectrum.size // BAND
    return float(np.std(spectrum[: count * BAND].reshape(count, BAND).mean(axis=1))) if count else 0.0


def _with_fan(prepared: Prepared, values: Values) -> Prepared:
    measurement = prepared.measurement
    return replace(prepared, measurement=replace(measurement, noise_psd=find(NAME).noise_psd(values, measurement.noise_psd)))


def judge_behind(gain: Samples, prepared: Prepared, prediction: Samples, unpredictable: Sequence[tuple[Samples, Array]] = ()) -> Verdict:
    """The verdict on an already corrected prediction (n,), with a microphone's gain (n,) taken out of the residual."""
    flat = replace(prepared, measurement=replace(prepared.measurement, recording=(prepared.measurement.recording - prediction) / gain))
    return replace(Judge(flat).judge(np.zeros_like(prediction), correct=False, unpredictable=unpredictable), prediction=prediction)


def _judged(prepared: Prepared, found: Found, gain: Samples) -> Verdict:
    """The verdict on what a search ends with."""
    return judge_behind(gain, prepared, found.final.prediction, found.model.unpredictable(prepared.measurement.reference))
