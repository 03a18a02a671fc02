"""A player or amplifier that lets no peak through above its ceiling."""

from __future__ import annotations

from itertools import product

import numpy as np

from edgefilter.echo.effect import Effect, Parameter, Runner, first, within
from edgefilter.echo.effects.compression import falling_peak
from edgefilter.echo.effects.gain_fit import Reach, fit_one
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import Array, Samples

NEVER_DB = 60.0
"""Re full scale: a ceiling that no signal reaches."""
STARTS = tuple(product((9.0, 6.0, 3.0, 0.0, -5.0), np.log([20.0, 100.0, 500.0])))
"""Ceilings in dB re the loudest 20 ms of the reference, 10 dB under its peaks, and logarithms of releases in ms to start from."""
SHORTEST_MS = 10.0
"""What lets go faster, within a period of the voice, bends the wave itself: that is distortion."""
REACH = Reach(
    nudge=np.array([0.3, 0.15]),
    lowest=np.array([-80.0, np.log(SHORTEST_MS)]),
    highest=np.array([0.0, np.log(5000.0)]),
)
"""Of ceiling in dB and release as a natural logarithm of ms."""


class Limiter(Effect):
    """Peak limiter: x times min(1, ceiling / p), p the peak of |x|, which rises at once and falls exponentially, then make-up gain.

    A compressor of infinite ratio without attack time (Giannoulis, Massberg & Reiss 2012, section 1); it differs from
    that of `compression` in that it hears peaks rather than the mean square. taken_db only reports: by how much the
    loudest peak is turned down.
    """

    name = "limiter"
    stage = "source"
    family = "dynamics"
    title = "a limiter"
    complexity = 2
    parameters = (
        Parameter("ceiling_db", "dB re full scale", NEVER_DB, -80.0, NEVER_DB),
        Parameter("release_ms", "ms", 100.0, 1.0, 5000.0),
        Parameter("makeup_db", "dB", 0.0, -40.0, 40.0),
        Parameter("taken_db", "dB", 0.0, 0.0, 140.0),
    )

    def run(self, values: Values, sample_rate: int) -> Runner:
        return PeakLimiter(values, sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """From the best of a grid of ceilings and releases (gain_fit)."""
        values = fit_one(self, measurement, model, self._values, REACH, STARTS, by_peaks=True)
        peak_db = 20.0 * np.log10(float(np.max(np.abs(measurement.reference), initial=0.0)) + 1e-12)
        return within(self, {**values, "taken_db": peak_db - first(values, "ceiling_db")})

    def _values(self, unknowns: Array) -> Values:
        return within(self, {"ceiling_db": unknowns[0], "release_ms": np.exp(unknowns[1])})

    def sentence(self, values: Values) -> str:
        return (
            f"no peak of the voice is let through above {first(values, 'ceiling_db'):.0f} dB re full scale: the loudest is"
            f" turned down by {first(values, 'taken_db'):.1f} dB, and the gain comes back in"
            f" {first(values, 'release_ms'):.0f} ms"
        )


class PeakLimiter:
    """One limiter on a stream, (n,) -> (n,): values as of Limiter."""

    def __init__(self, values: Values, sample_rate: int) -> None:
        self._ceiling, self._makeup = (10.0 ** (float(values[name]) / 20.0) for name in ("ceiling_db", "makeup_db"))
        self._release = float(values["release_ms"]) * 1e-3 * sample_rate
        self._peak = 0.0

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        peak = falling_peak(np.abs(x, dtype=np.float64), self._release, self._peak)
        self._peak = float(peak[-1]) if peak.size else self._peak
        return (x * (self._makeup * self._ceiling / np.maximum(peak, self._ceiling))).astype(np.float32)
