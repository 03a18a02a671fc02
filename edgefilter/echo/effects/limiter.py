"""A player or amplifier that lets no peak through above its ceiling."""

from __future__ import annotations

from itertools import product
from typing import ClassVar

import numpy as np

from edgefilter.echo.effect import Effect, Experiment, Family, Parameter, Runner, Stage, complete, first, neutral
from edgefilter.echo.effects.compression import falling_peak
from edgefilter.echo.effects.gain_fit import GainFit, Reach
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

NEVER_DB = 60.0
CEILINGS_DB, RELEASES_MS = (9.0, 6.0, 3.0, 0.0, -5.0), (20.0, 100.0, 500.0)
"""Starting points, the former relative to the loudest 20 ms of the reference: peaks of speech are some 10 dB above its level."""
SHORTEST_MS = 10.0
"""What lets go faster, within a period of the voice, bends the wave itself: that is distortion."""
REACH = Reach(
    nudge=np.array([0.3, 0.15]),
    longest=np.array([3.0, 1.0]),
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

    name: ClassVar[str] = "limiter"
    stage: ClassVar[Stage] = "source"
    family: ClassVar[Family] = "dynamics"
    title: ClassVar[str] = "a limiter"
    shown_by: ClassVar[tuple[Experiment, ...]] = ("levels",)
    complexity: ClassVar[int] = 2
    cost: ClassVar[int] = 2
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("ceiling_db", "dB re full scale", NEVER_DB, -80.0, NEVER_DB),
        Parameter("release_ms", "ms", 100.0, 1.0, 5000.0),
        Parameter("makeup_db", "dB", 0.0, -40.0, 40.0),
        Parameter("taken_db", "dB", 0.0, 0.0, 140.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Return x (n,) with its peaks held down, times the make-up gain."""
        return PeakLimiter(values, sample_rate)(x)

    def run(self, values: Values, sample_rate: int) -> Runner:
        """The limiter, which carries its peak on."""
        return PeakLimiter(values, sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Gauss-Newton in ceiling and release from the best of a coarse grid; a short filter takes up the linear rest."""

        def limited(x: Samples, unknowns: Array) -> tuple[Samples]:
            return (self.apply(x, complete(self, _values(unknowns)), SAMPLE_RATE),)

        fit = GainFit(measurement, model, limited, REACH)
        found = fit.best([np.array((fit.loud_db + db, np.log(ms))) for db, ms in product(CEILINGS_DB, RELEASES_MS)])
        if found is None:
            return neutral(self)
        values = _values(found[0])
        peak_db = 20.0 * np.log10(float(np.max(np.abs(measurement.reference), initial=0.0)) + 1e-12)
        makeup = 20.0 * np.log10(max(float(fit.gains(found[0])[0]), 1e-2))
        taken = float(np.clip(peak_db - values["ceiling_db"], 0.0, 140.0))
        return {**values, "makeup_db": float(np.clip(makeup, -40.0, 40.0)), "taken_db": taken}

    def sentence(self, values: Values) -> str:
        """The ceiling, and what it takes away."""
        return (
            f"no peak of the voice is let through above {first(values, 'ceiling_db'):.0f} dB re full scale: the loudest is"
            f" turned down by {first(values, 'taken_db'):.1f} dB, and the gain comes back in"
            f" {first(values, 'release_ms'):.0f} ms"
        )


class PeakLimiter:
    """One limiter on a stream: values as of Limiter."""

    def __init__(self, values: Values, sample_rate: int) -> None:
        self._ceiling, self._makeup = (10.0 ** (float(values[name]) / 20.0) for name in ("ceiling_db", "makeup_db"))
        self._release = float(values["release_ms"]) * 1e-3 * sample_rate
        self._peak = 0.0

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        """Return x (n,), which follows what came before, times its gain."""
        peak = falling_peak(np.abs(x, dtype=np.float64), self._release, self._peak)
        self._peak = float(peak[-1]) if peak.size else self._peak
        return (x * (self._makeup * self._ceiling / np.maximum(peak, self._ceiling))).astype(np.float32)


def _values(unknowns: Array) -> dict[str, float]:
    return {"ceiling_db": float(unknowns[0]), "release_ms": float(np.clip(np.exp(unknowns[1]), 1.0, 5000.0))}
