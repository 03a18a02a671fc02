"""Another path all along: the robot or its microphone stands elsewhere, or its casing is another."""

from __future__ import annotations

import numpy as np

from edgefilter.echo.effect import Effect, Parameter, first, neutral, within
from edgefilter.echo.effects.late_reverb import LEAD, fit_path, rings_longer, with_taps
from edgefilter.echo.evidence import Evidence
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Samples

WITHIN = 0.8
"""Part of what is added that has come by within_ms: the rest is the fit's noise and the room's own tail."""


class EarlyPath(Effect):
    """y = x + taps * x: a filter behind the calibrated path, after which the room dies away as it did.

    taps: (k,) lags -LEAD to k - LEAD. level_db: their energy re the calibrated sound. within_ms: the lag by which
    WITHIN of it has come. The filter is as long as that of late_reverb: where the microphone is another, so is each
    reflection.
    """

    name = "early_path"
    stage = "path"
    family = "linear path"
    title = "another path from the start"
    shown_by = ("sweep", "place")
    complexity = 4
    cost = 4
    flexible = True
    parameters = (
        Parameter("level_db", "dB", -120.0, -120.0, 60.0),
        Parameter("within_ms", "ms", 0.0, -10.0, 1000.0),
        Parameter("taps", "1", 0.0, -10.0, 10.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        return with_taps(x, values)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The taps that fit_path() finds, which late_reverb shares; neutral where none hold on other samples."""
        taps, _ = measurement.once(fit_path, model)
        if not taps.any():
            return neutral(self)
        grown = np.cumsum(taps**2)
        level_db = 10.0 * np.log10(grown[-1] + 1e-12)
        within_ms = 1e3 * (int(np.searchsorted(grown, WITHIN * grown[-1])) - LEAD) / SAMPLE_RATE
        return within(self, {"level_db": level_db, "within_ms": within_ms, "taps": taps})

    def sentence(self, values: Values) -> str:
        return (
            f"direct sound and reflections, most of them within {max(first(values, 'within_ms'), 0.0):.0f} ms, are"
            " others than at the calibration, from the first second to the last; the room dies away as it did"
        )

    def plausible(self, evidence: Evidence) -> bool:
        """Whether the room does not sound longer than it did: else the room is another."""
        return not rings_longer(evidence)
