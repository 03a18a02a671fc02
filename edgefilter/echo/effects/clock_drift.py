"""Player and microphone count time with two crystals."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.fractional_delay import interpolate
from edgefilter.echo.effect import Parameter, Shift, first, neutral, within
from edgefilter.echo.lag_track import BLOCK, REACH, lags_of, track_lag
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import Array

STEADY = 0.05
"""Samples by which a block's lag may err for other reasons than noise."""
LEAST = 0.5
"""Least difference of two clocks, in 1e-6, or lag at the start, in samples: what tests/echo/effects/test_timing.py lets a fit err by
beside faint distortion."""


class ClockDrift(Shift):
    """y(n) = x(n - offset + ppm 1e-6 n): a delay that shrinks with positive, grows with negative ppm.

    Interpolation by a windowed sinc of 48 samples, see dsp.fractional_delay. Valid where the drift is constant over the
    recording.
    """

    name = "clock_drift"
    run_note = (
        "the running filter follows the clocks by itself, whatever they did in this recording: adding it changes nothing"
        " there"
    )
    title = "clock drift"
    followed = True
    complexity = 1
    parameters = (
        Parameter("ppm", "1e-6", 0.0, -1000.0, 1000.0),
        Parameter("offset", "samples", 0.0, -32000.0, 32000.0),
    )

    def read_at(self, values: Values, size: int, sample_rate: int) -> Array:
        n = np.arange(size)
        return n - float(values["offset"]) + 1e-6 * float(values["ppm"]) * n

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Fit a robust line to the lags of all blocks, compensate that drift, and fit again to longer blocks, which the drift would have smeared."""
        track, n = measurement.once(lags_of, model), np.arange(measurement.recording.size)
        if track.lag.size < 3:
            return neutral(self)
        slope, offset = robust_line(track.middle, track.lag, track.sigma)
        if max(1e6 * abs(slope), abs(offset)) < LEAST:
            return neutral(self)
        straight = measurement.whiten(interpolate(measurement.predicted(model)[0], n - offset - slope * n))
        track = track_lag(straight, measurement.white_recording, measurement.fit, 2 * BLOCK, REACH)
        if track.lag.size >= 3:
            slope, offset = robust_line(track.middle, track.lag + offset + slope * track.middle, track.sigma)
        return within(self, {"ppm": -1e6 * slope, "offset": offset})

    def sentence(self, values: Values) -> str:
        return f"the lag grows along a line, by {abs(first(values, 'ppm')):.1f} samples in a million"


def robust_line(x: Array, y: Array, sigma: Array) -> tuple[float, float]:
    """Slope and offset of y (m,) over rising x (m,): from the median of all pairwise slopes (Theil-Sen), then Tukey's biweight."""
    one, later = np.triu_indices(x.size, 1)  # not by scipy.stats: importing it takes a second
    slope = np.median((y[later] - y[one]) / (x[later] - x[one]))
    offset = np.median(y - slope * x)
    spread = np.hypot(sigma, STEADY)
    for _ in range(10):
        distance = (y - slope * x - offset) / spread
        scale = max(float(1.4826 * np.median(np.abs(distance))), 1.0)
        keep = np.clip(1.0 - (distance / (4.685 * scale)) ** 2, 0.0, None)
        if np.count_nonzero(keep) < 3:
            break
        slope, offset = np.polyfit(x, y, 1, w=keep / spread)
    return float(slope), float(offset)
