"""The volume was turned since the calibration."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from edgefilter.echo.effect import Effect, Family, Parameter, Stage, first
from edgefilter.echo.measurement import Measurement, Values, VoiceModel, level_ratio
from edgefilter.types import Samples


class PlaybackGain(Effect):
    """One gain for all frequencies, before the loudspeaker."""

    name: ClassVar[str] = "playback_gain"
    stage: ClassVar[Stage] = "source"
    family: ClassVar[Family] = "linear path"
    title: ClassVar[str] = "a turned volume"
    followed: ClassVar[bool] = True
    complexity: ClassVar[int] = 0
    memory: ClassVar[int | None] = 0
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("gain_db", "dB", 0.0, -60.0, 60.0),)

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Return x times the gain."""
        return x * np.float32(10.0 ** (float(values["gain_db"]) / 20.0))

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The least-squares gain of the whitened prediction, held within the bounds."""
        predicted = measurement.heard(model)[1] * measurement.weights
        gain = level_ratio(measurement.white_recording, predicted)
        return {"gain_db": float(np.clip(20.0 * np.log10(max(gain, 1e-3)), -60.0, 60.0))}

    def sentence(self, values: Values) -> str:
        """By how much, and which way."""
        gain_db = first(values, "gain_db")
        return (
            f"the voice is {abs(gain_db):.2f} dB {'louder' if gain_db > 0 else 'softer'} at all frequencies and levels"
            " alike"
        )
