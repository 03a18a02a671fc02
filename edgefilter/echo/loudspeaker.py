"""A loudspeaker driven hard: it adds harmonics and intermodulation."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from edgefilter.echo.effect import Measurement, Parameter, Stage, Values
from edgefilter.types import Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel


class SpeakerNonlinearity:
    """Memoryless polynomial y = x + even x^2 + odd x^3 ahead of the linear path (a Hammerstein model).

    Valid while the added terms are well below x; the coefficients are per full scale.
    """

    name: ClassVar[str] = "speaker_nonlinearity"
    stage: ClassVar[Stage] = "source"
    memoryless: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("even", "1/full scale", 0.0, -20.0, 20.0),
        Parameter("odd", "1/full scale^2", 0.0, -200.0, 200.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """The polynomial, sample by sample."""
        square = x * x
        return x + np.float32(values["even"]) * square + np.float32(values["odd"]) * square * x

    def fit(self, measurement: Measurement, model: EchoModel) -> Values:
        """Least squares in the three path-filtered powers of the reference; the linear term takes up a change of gain."""
        x = measurement.reference
        columns = np.stack([model.predict(power) for power in (x, x * x, x**3)], axis=1).astype(np.float64)
        scale = np.sqrt((columns**2).sum(axis=0)) + 1e-30
        weights = np.linalg.lstsq(columns / scale, measurement.recording.astype(np.float64), rcond=1e-9)[0] / scale
        if weights[0] == 0.0:
            return {"even": 0.0, "odd": 0.0}
        even, odd = weights[1:] / weights[0]
        return {"even": float(np.clip(even, -20.0, 20.0)), "odd": float(np.clip(odd, -200.0, 200.0))}
