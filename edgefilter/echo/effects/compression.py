"""A player or amplifier that turns loud passages down."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import ClassVar

import numpy as np
import scipy

from edgefilter.dsp.frames import block_power, decibels
from edgefilter.echo.effect import Effect, Parameter, Runner, Stage, complete, first, neutral
from edgefilter.echo.evidence import Evidence
from edgefilter.echo.least_squares import Normal, normal_equations
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

EXCERPT = 8 * SAMPLE_RATE
"""The loudest stretch of that many samples is fitted."""
TAPS, LEAD = 8, 4
"""Of the nuisance filter on the compressed prediction: what is linear, the make-up gain included."""
THRESHOLDS_DB, SLOPES = (1.0, -3.0, -8.0, -15.0), (0.2, 0.6)
"""Starting points, relative to the loudest 20 ms of the reference, and dB per dB."""
RELEASES_MS = (60.0, 300.0)
SILENT_DB = -80.0
STEEPEST = 0.98
ITERATIONS = 6
DAMPINGS = (1e-4, 1e-2, 0.3)
UNKNOWNS = ("threshold_db", "slope", "attack", "release")
NUDGE = np.array([0.5, 0.03, 0.15, 0.15])
"""Steps of the numerical derivatives: dB, dB per dB, natural logarithms of times."""
LARGEST = np.array([4.0, 0.3, 1.0, 1.0])
LOWEST = np.array([-80.0, 0.0, np.log(0.3), np.log(5.0)])
HIGHEST = np.array([0.0, STEEPEST, np.log(200.0), np.log(5000.0)])


class Compression(Effect):
    """Feed-forward compressor: above threshold the level rises by 1 / ratio dB per dB, over a knee, then make-up gain.

    After Giannoulis, Massberg & Reiss 2012, "Digital dynamic range compressor design": the level is the mean square
    over the attack time, in dB; the gain computer with a soft knee (their eq. 4) asks for a reduction; that rises at
    once and falls exponentially with the release time, as in their decoupled peak detector (eq. 17).
    """

    name: ClassVar[str] = "compression"
    stage: ClassVar[Stage] = "source"
    title: ClassVar[str] = "compression"
    complexity: ClassVar[int] = 2
    cost: ClassVar[int] = 2
    flexible: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("threshold_db", "dB re full scale", -20.0, -80.0, 0.0),
        Parameter("ratio", "dB/dB", 1.0, 1.0, 50.0),
        Parameter("attack_ms", "ms", 10.0, 0.1, 1000.0),
        Parameter("release_ms", "ms", 200.0, 1.0, 5000.0),
        Parameter("knee_db", "dB", 6.0, 0.0, 30.0),
        Parameter("makeup_db", "dB", 0.0, -40.0, 40.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """X (n,) times the gain that its own level asks for, times the make-up gain."""
        return Compressor(values, sample_rate)(x)

    def run(self, values: Values, sample_rate: int) -> Runner:
        """The compressor, which carries its level and its reduction on."""
        return Compressor(values, sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Gauss-Newton in threshold, ratio, attack and release from the best of a coarse grid.

        A short filter takes up the linear rest.

        No compression where four numbers do not pay for themselves by Bayes' information criterion.
        """
        part, fit = _loudest(measurement, from_start=model.timed)
        x, target = measurement.reference[part], measurement.whiten(measurement.recording[part])
        loud_db = float(decibels(np.max(block_power(x, SAMPLE_RATE // 50), initial=0.0), 1e-9))

        def predict(unknowns: Array) -> Samples:
            return measurement.whiten(model.predict(self.apply(x, complete(self, _values(unknowns)), SAMPLE_RATE)))

        def left(predicted: Samples) -> float:
            return normal_equations([predicted], target, TAPS, LEAD, fit).solve()[1]

        plain = normal_equations([measurement.whiten(model.predict(x))], target, TAPS, LEAD, fit)
        without = plain.solve()[1]
        grid = product(THRESHOLDS_DB, SLOPES, RELEASES_MS)
        starts = [
            np.clip((loud_db + above, slope, np.log(8.0), np.log(release)), LOWEST, HIGHEST)
            for above, slope, release in grid
        ]
        costs = [left(predict(start)) for start in starts]
        best, cost = starts[int(np.argmin(costs))], min(costs)
        if cost >= without:
            return neutral(self)
        for _ in range(ITERATIONS if loud_db > SILENT_DB else 0):
            best, now = _gauss_newton(best, cost, predict, left, target, fit)
            if now > cost * (1.0 - 1e-3):
                break
            cost = now
        worth = len(UNKNOWNS) * np.log(max(plain.count, 2)) * cost / max(plain.count, 1)
        if without - cost <= worth or best[1] < 0.01:
            return neutral(self)
        return {**_values(best), "makeup_db": self._makeup(measurement, model, _values(best))}

    def _makeup(self, measurement: Measurement, model: VoiceModel, values: Values) -> float:
        """Least-squares gain over the whole recording, dB."""
        predicted = measurement.whiten(
            model.predict(self.apply(measurement.reference, complete(self, values), SAMPLE_RATE))
        )
        normal = normal_equations([predicted], measurement.white_recording, 1, 0, measurement.fit)
        return float(np.clip(20.0 * np.log10(max(float(normal.solve()[0][0, 0]), 1e-2)), -40.0, 40.0))

    def sentence(self, values: Values) -> str:
        """From where on the level is held down, and by how much."""
        return (
            f"the voice is turned down when it has been loud: above {first(values, 'threshold_db'):.0f} dB "
            f"by {first(values, 'ratio'):.1f} to 1, while the fan is as loud as ever"
        )

    def plausible(self, evidence: Evidence) -> bool:
        """The gain follows the level."""
        return float(evidence.values["ratio"]) >= 1.1


class Compressor:
    """One compressor on a stream: values as of Compression."""

    def __init__(self, values: Values, sample_rate: int) -> None:
        self._slope, self._makeup = 1.0 - 1.0 / float(values["ratio"]), float(values["makeup_db"])
        self._threshold, self._knee = float(values["threshold_db"]), float(values["knee_db"])
        self._keep = np.exp(-1.0 / (float(values["attack_ms"]) * 1e-3 * sample_rate))
        self._release = float(values["release_ms"]) * 1e-3 * sample_rate
        self._level, self._held = np.zeros(1), 0.0

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        """X (n,), which follows what came before, times its gain."""
        if self._slope == 0.0:
            return x * np.float32(10.0 ** (self._makeup / 20.0))
        square = np.square(x, dtype=np.float64)
        power, self._level = scipy.signal.lfilter([1.0 - self._keep], [1.0, -self._keep], square, zi=self._level)
        over, knee = 10.0 * np.log10(power + 1e-12) - self._threshold, self._knee
        bent = np.clip(over + knee / 2, 0.0, knee) ** 2 / (2 * knee) if knee > 0.0 else 0.0
        held = _falling_peak(bent + np.maximum(over - knee / 2, 0.0), self._release, self._held)
        self._held = float(held[-1]) if held.size else self._held
        return (x * 10.0 ** ((self._makeup - self._slope * held) / 20.0)).astype(np.float32)


def _falling_peak(x: Array, samples: float, before: float) -> Array:
    """y(n) = max(x(n), y(n - 1) e^(-1 / samples)) for x >= 0, as a running maximum of ln x + n / samples; before is y(-1)."""
    rise = np.arange(x.size) / samples
    level = np.log(x + 1e-12) + rise
    if before > 0.0 and level.size:
        level[0] = max(float(level[0]), float(np.log(before)) - 1.0 / samples)
    return np.exp(np.maximum.accumulate(level) - rise)


def _values(unknowns: Array) -> dict[str, float]:
    threshold, slope, attack, release = (float(u) for u in unknowns)
    attack_ms, release_ms = float(np.clip(np.exp(attack), 0.1, 1000.0)), float(np.clip(np.exp(release), 1.0, 5000.0))
    return {"threshold_db": threshold, "ratio": 1.0 / (1.0 - slope), "attack_ms": attack_ms, "release_ms": release_ms}


def _loudest(measurement: Measurement, from_start: bool) -> tuple[slice, np.ndarray]:
    """The stretch with most energy, or the first one where the model knows what time it is; and its samples to fit on.

    The first half second of a later stretch is left out: in it the level settles.
    """
    x = measurement.reference
    fit = np.ones(x.size, bool) if measurement.fit is None else measurement.fit
    start = 0
    if x.size > EXCERPT and not from_start:
        energy = np.concatenate(([0.0], np.cumsum(x.astype(np.float64) ** 2)))
        start = int(np.argmax(energy[EXCERPT:] - energy[:-EXCERPT]))
    part = slice(start, start + EXCERPT)
    chosen = fit[part].copy()
    if start:
        chosen[: SAMPLE_RATE // 2] = False
    return part, chosen


def _gauss_newton(
    at: Array,
    cost: float,
    predict: Callable[[Array], Samples],
    left: Callable[[Samples], float],
    target: Samples,
    fit: np.ndarray,
) -> tuple[Array, float]:
    """One step, damped and shortened until it helps (Levenberg 1944); the unknowns and cost that it reaches."""
    base = predict(at)
    nudge = np.where(at + NUDGE > HIGHEST, -NUDGE, NUDGE)
    changes = [predict(at + nudge * unit) - base for unit in np.eye(at.size)]
    use = np.zeros((1 + at.size, TAPS), bool)
    use[0], use[1:, LEAD] = True, True
    normal: Normal = normal_equations([base, *changes], target, TAPS, LEAD, fit)
    for damping in DAMPINGS:
        weights, _ = normal.solve(damping, use)
        step = np.clip(weights[1:, LEAD] / (float(weights[0].sum()) or 1.0) * nudge, -LARGEST, LARGEST)
        for shorter in (1.0, 0.3):
            there = np.clip(at + shorter * step, LOWEST, HIGHEST)
            now = left(predict(there))
            if now < cost:
                return there, now
    return at, cost
