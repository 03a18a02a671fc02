"""Another path all along: the robot or its microphone stands elsewhere, or its casing is another."""

from __future__ import annotations

import numpy as np

from edgefilter.echo.effect import Parameter, first, neutral, within
from edgefilter.echo.effects.late_reverb import ADDED, AddedResponse, fit_path
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import PRE_ROLL, SAMPLE_RATE

WITHIN = 0.8
"""Part of what is added that has come by within_ms: the rest is the fit's noise and the room's own tail."""


class EarlyPath(AddedResponse):
    """h + added: another impulse response, after which the room dies away as it did.

    level_db: energy of what is added re that of h. within_ms: the lag behind the direct sound by which WITHIN of it has
    come. It is as long as that of late_reverb: where the microphone is another, so is each reflection.
    """

    name = "early_path"
    title = "another path from the start"
    parameters = (
        Parameter("level_db", "dB", -120.0, -120.0, 60.0),
        Parameter("within_ms", "ms", 0.0, -10.0, 1000.0),
        *ADDED,
    )

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Take the change of the impulse response that fit_path() finds, which is computed once for this effect and late_reverb.

        The values are neutral where the change does not lower the error on held-out samples, or where the room reverberates longer.
        """
        added, _, longer = measurement.once(fit_path, model)
        grown = np.cumsum(added**2)
        if longer or not grown[-1]:
            return neutral(self)
        level_db = 10.0 * np.log10(grown[-1] / np.sum(model.response().astype(float) ** 2) + 1e-12)
        within_ms = 1e3 * (int(np.searchsorted(grown, WITHIN * grown[-1])) - PRE_ROLL) / SAMPLE_RATE
        return within(self, {"level_db": level_db, "within_ms": within_ms, "added": added})

    def sentence(self, values: Values) -> str:
        return (
            f"direct sound and reflections, most of them within {max(first(values, 'within_ms'), 0.0):.0f} ms, are"
            " others than at the calibration, from the first second to the last; the room dies away as it did"
        )
