"""A player or amplifier that turns loud passages down."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import scipy

from edgefilter.echo.effect import Measurement, Parameter, Stage, Values, level_ratio
from edgefilter.types import SAMPLE_RATE, Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel


class Compression:
    """Feed-forward compressor with a hard knee: above threshold the level rises by 1 / ratio dB per dB.

    The level is the larger of two one-pole means of x^2, a fast one (attack) and the fast one smoothed on (release), so that it
    rises with the attack and falls with the release time.
    """

    name: ClassVar[str] = "compression"
    stage: ClassVar[Stage] = "source"
    memoryless: ClassVar[bool] = False
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("threshold_db", "dB re full scale", -20.0, -80.0, 0.0),
        Parameter("ratio", "dB/dB", 1.0, 1.0, 50.0),
        Parameter("attack_s", "s", 0.01, 1e-4, 1.0),
        Parameter("release_s", "s", 0.2, 1e-3, 5.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """x times the gain that its own level asks for."""
        if float(values["ratio"]) == 1.0:
            return x.copy()
        fast = _one_pole(np.square(x, dtype=np.float64), float(values["attack_s"]), sample_rate)
        level = np.maximum(fast, _one_pole(fast, float(values["release_s"]), sample_rate))
        above = np.maximum(10.0 * np.log10(level + 1e-12) - float(values["threshold_db"]), 0.0)
        gain_db = (1.0 / float(values["ratio"]) - 1.0) * above
        return (x * 10.0 ** (gain_db / 20.0)).astype(np.float32)

    def fit(self, measurement: Measurement, model: EchoModel) -> Values:
        """The best of a grid of thresholds and ratios, with the usual attack and release and the best overall gain."""
        x = measurement.reference
        peak_db = 10.0 * np.log10(float(np.max(_one_pole(np.square(x, dtype=np.float64), 0.01, SAMPLE_RATE), initial=1e-12)) + 1e-12)
        best, best_error = {"threshold_db": -20.0, "ratio": 1.0, "attack_s": 0.01, "release_s": 0.2}, np.inf
        for below, ratio in product((3.0, 6.0, 9.0, 12.0, 18.0, 24.0), (1.0, 1.5, 2.0, 3.0, 5.0, 8.0)):
            values = {**best, "threshold_db": float(np.clip(peak_db - below, -80.0, 0.0)), "ratio": ratio}
            predicted = model.predict(self.apply(x, values, SAMPLE_RATE))
            error = measurement.recording - level_ratio(measurement.recording, predicted) * predicted
            power = float(np.dot(error, error))
            if power < best_error:
                best, best_error = values, power
        return best


def _one_pole(x: np.ndarray, seconds: float, sample_rate: int) -> np.ndarray:
    """Exponential mean with that time constant."""
    keep = np.exp(-1.0 / (seconds * sample_rate))
    return scipy.signal.lfilter([1.0 - keep], [1.0, -keep], x)
