"""Player and microphone count time with two crystals."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy import fft

from edgefilter.echo.effect import Measurement, Parameter, Stage, Values
from edgefilter.types import Array, Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel

HALF_WIDTH = 16
"""Samples on either side that the interpolation kernel uses."""
WINDOW = 16384
REACH = 400


class ClockDrift:
    """y(n) = x(n - offset + ppm 1e-6 n): a delay that shrinks with positive, grows with negative ppm.

    Interpolation by a Kaiser-windowed sinc (beta 8) of 32 samples; flat to 0.1 dB up to 7 kHz.
    """

    name: ClassVar[str] = "clock_drift"
    stage: ClassVar[Stage] = "time"
    memoryless: ClassVar[bool] = False
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("ppm", "1e-6", 0.0, -1000.0, 1000.0),
        Parameter("offset", "samples", 0.0, -32000.0, 32000.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """x (n,) read at the drifting clock; outside of x there is silence."""
        ppm, offset = float(values["ppm"]), float(values["offset"])
        if ppm == 0.0 and offset == 0.0:
            return x.copy()
        n = np.arange(x.size)
        return _interpolate(x, n - offset + 1e-6 * ppm * n)

    def fit(self, measurement: Measurement, model: EchoModel) -> Values:
        """A line through the lags of windows of one second, weighted by their energy (GCC in the model's prediction)."""
        predicted, recording = model.predict(measurement.reference), measurement.recording
        times, lags, weights = [], [], []
        for at in range(0, min(predicted.size, recording.size) - WINDOW + 1, WINDOW // 2):
            a, b = predicted[at : at + WINDOW], recording[at : at + WINDOW]
            energy = float(np.sqrt(np.dot(a, a) * np.dot(b, b)))
            if energy > 0.0:
                times.append(at + WINDOW / 2)
                lags.append(_lag(a, b))
                weights.append(energy)
        if len(times) < 2:
            return {"ppm": 0.0, "offset": lags[0] if lags else 0.0}
        slope, offset = np.polyfit(times, lags, 1, w=np.sqrt(weights))
        return {"ppm": float(np.clip(-1e6 * slope, -1000.0, 1000.0)), "offset": float(offset)}


def _lag(a: Samples, b: Samples) -> float:
    """By how many samples b is behind a; parabola through the peak of the cross-correlation."""
    n = 2 * a.size
    cross = fft.irfft(fft.rfft(b, n) * np.conj(fft.rfft(a, n)), n)
    near = np.concatenate((cross[-REACH:], cross[: REACH + 1]))
    k = int(np.clip(np.argmax(near), 1, near.size - 2))
    left, mid, right = near[k - 1 : k + 2]
    bend = left - 2.0 * mid + right
    return float(k - REACH + (0.5 * (left - right) / bend if bend < 0.0 else 0.0))


def _interpolate(x: Samples, positions: Array) -> Samples:
    """x at real positions (n,), in chunks so that memory stays bounded."""
    out = np.zeros(positions.size, np.float32)
    padded = np.concatenate((np.zeros(HALF_WIDTH, np.float32), x, np.zeros(HALF_WIDTH + 1, np.float32)))
    steps = np.arange(-HALF_WIDTH + 1, HALF_WIDTH + 1)
    for at in range(0, positions.size, 8192):
        p = positions[at : at + 8192]
        base = np.floor(p).astype(np.int64)
        distance = steps[None, :] - (p - base)[:, None]
        shape = np.i0(8.0 * np.sqrt(np.clip(1.0 - (distance / HALF_WIDTH) ** 2, 0.0, 1.0))) / np.i0(8.0)
        index = np.clip(base[:, None] + steps[None, :] + HALF_WIDTH, 0, padded.size - 1)
        out[at : at + 8192] = np.einsum("ij,ij->i", padded[index], np.sinc(distance) * shape)
    return out
