"""The volume was turned since the calibration."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from edgefilter.echo.effect import Measurement, Parameter, Stage, Values, level_ratio
from edgefilter.types import Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel


class PlaybackGain:
    """One gain for all frequencies, before the loudspeaker."""

    name: ClassVar[str] = "playback_gain"
    stage: ClassVar[Stage] = "source"
    memoryless: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("gain_db", "dB", 0.0, -60.0, 60.0),)

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """x times the gain."""
        return x * np.float32(10.0 ** (float(values["gain_db"]) / 20.0))

    def fit(self, measurement: Measurement, model: EchoModel) -> Values:
        """The least-squares gain of the whitened prediction, held within the bounds."""
        predicted = measurement.heard(model)[1] * measurement.weights
        gain = level_ratio(measurement.white_recording, predicted)
        return {"gain_db": float(np.clip(20.0 * np.log10(max(gain, 1e-3)), -60.0, 60.0))}
