"""Within a second: which families of effects a recording shows, and how much each, by their free laws on its loudest seconds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.straightened import Straightened
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import EFFECTS
from edgefilter.echo.effects.gain_fit import EXCERPT, excerpt
from edgefilter.echo.recording import BLOCK
from edgefilter.errors import UsageError


def at_first_sight(recording: Straightened, criteria: Criteria) -> dict[str, float]:
    """By how many dB another volume, and beside it the best free law of each family, lower the held-out level of the loudest seconds.

    The largest first, and only those that do so by more than chance. A family that is hidden behind another one is not seen yet.
    """
    part = _loudest(recording)
    before, turned = (part.of(part.model, any_volume).level_db for any_volume in (False, True))
    found = {"volume": before - turned}
    for effect in EFFECTS:
        # another impulse response fits as much as any law may, and has more taps than the linear path here
        if not (effect.free or effect.stage == "noise" or (effect.stage == "response" and not effect.event)):
            continue
        try:
            values = part.model.fitted(effect.name, part.measurement)
        except (UsageError, ArithmeticError, np.linalg.LinAlgError):
            continue
        if vanishes(effect, values):
            continue
        gain_db = min(before, turned) - part.of(part.model.with_effect(effect.name, values)).level_db
        if p_value(effect.name, gain_db) <= criteria.false_rate:
            found[effect.family] = max(found.get(effect.family, 0.0), gain_db)
    # a volume is in no table: judged by the effect that explains most by chance
    if p_value("volume", found["volume"]) > criteria.false_rate:
        del found["volume"]
    return dict(sorted(found.items(), key=lambda entry: -entry[1]))


def _loudest(recording: Straightened) -> Straightened:
    """The stretch of a recording that a gain is fitted to, but for its first half second: the prediction lacks the echo of what was said before."""
    measurement = recording.measurement
    part = excerpt(measurement, recording.model, EXCERPT)
    usable = recording.usable[part].copy()
    if part.start:
        usable[:BLOCK] = False
    cut = replace(
        measurement,
        reference=measurement.reference[part],
        recording=measurement.recording[part],
        fit=recording.fit[part] & usable,
    )
    return replace(
        recording,
        measurement=cut,
        prediction=recording.prediction[part],
        usable=usable,
        active=recording.active[part],
        ordinary=tuple((variance[part], colour) for variance, colour in recording.ordinary),
    )
