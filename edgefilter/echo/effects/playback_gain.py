"""The volume was turned since the calibration."""

from __future__ import annotations

import numpy as np

from edgefilter.echo.effect import Effect, Parameter, first, within
from edgefilter.echo.measurement import Measurement, Values, VoiceModel, level_ratio
from edgefilter.types import Samples


class PlaybackGain(Effect):
    """y = 10^(gain_db / 20) x, before the loudspeaker."""

    name = "playback_gain"
    stage = "source"
    family = "linear path"
    title = "a turned volume"
    followed = True
    complexity = 0
    memory = 0
    parameters = (Parameter("gain_db", "dB", 0.0, -60.0, 60.0),)

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        return x * np.float32(10.0 ** (float(values["gain_db"]) / 20.0))

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The least-squares gain of the whitened prediction, held within the bounds."""
        predicted = measurement.predicted(model)[1] * measurement.weights
        gain = level_ratio(measurement.white_recording, predicted)
        return within(self, {"gain_db": 20.0 * np.log10(max(gain, 1e-3))})

    def sentence(self, values: Values) -> str:
        gain_db = first(values, "gain_db")
        return (
            f"the voice is {abs(gain_db):.2f} dB {'louder' if gain_db > 0 else 'softer'} at all frequencies and levels"
            " alike"
        )
