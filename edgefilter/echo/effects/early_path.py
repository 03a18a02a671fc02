"""Another path all along: the robot or its microphone stands elsewhere, or its casing is another."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from edgefilter.echo.effect import Effect, Experiment, Family, Parameter, Stage, first, neutral
from edgefilter.echo.effects.late_reverb import LEAD, fit_path, rings_longer
from edgefilter.echo.evidence import Evidence
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.echo.wiener import convolve_from
from edgefilter.types import SAMPLE_RATE, Samples

WITHIN = 0.8
"""Part of what is added that has come by within_ms: the rest is the fit's noise and the room's own tail."""


class EarlyPath(Effect):
    """y = x + taps * x: a filter behind the calibrated path, after which the room dies away as it did.

    taps: (k,) lags -LEAD to k - LEAD. level_db: their energy re the calibrated sound. within_ms: the lag by which
    WITHIN of it has come. The filter is as long as that of late_reverb: where the microphone is another, so is each
    reflection.
    """

    name: ClassVar[str] = "early_path"
    stage: ClassVar[Stage] = "path"
    family: ClassVar[Family] = "linear path"
    title: ClassVar[str] = "another path from the start"
    shown_by: ClassVar[tuple[Experiment, ...]] = ("sweep", "place")
    complexity: ClassVar[int] = 4
    cost: ClassVar[int] = 4
    flexible: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("level_db", "dB", -120.0, -120.0, 60.0),
        Parameter("within_ms", "ms", 0.0, -10.0, 1000.0),
        Parameter("taps", "1", 0.0, -10.0, 10.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Put x through the other path."""
        taps = np.atleast_1d(np.asarray(values["taps"], float))
        return x.copy() if not taps.any() else x + convolve_from(x, taps, LEAD)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """As late_reverb's; neutral where nothing of it holds on other samples."""
        taps, _ = measurement.once(fit_path, model)
        if not taps.any():
            return neutral(self)
        grown = np.cumsum(taps**2)
        return {
            "level_db": float(np.clip(10.0 * np.log10(grown[-1] + 1e-12), -120.0, 60.0)),
            "within_ms": 1e3 * (int(np.searchsorted(grown, WITHIN * grown[-1])) - LEAD) / SAMPLE_RATE,
            "taps": np.clip(taps, -10.0, 10.0),
        }

    def sentence(self, values: Values) -> str:
        """What changed, and what did not."""
        return (
            f"direct sound and reflections, most of them within {max(first(values, 'within_ms'), 0.0):.0f} ms, are"
            " others than at the calibration, from the first second to the last; the room dies away as it did"
        )

    def plausible(self, evidence: Evidence) -> bool:
        """Whether the room does not sound longer than it did: else the room is another."""
        return not rings_longer(evidence)
