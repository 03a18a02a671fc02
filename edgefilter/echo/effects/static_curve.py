"""A static nonlinearity whose law is free: an amplifier, a valve, a rectifier, a converter, whatever its curve."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from edgefilter.echo.effect import Effect, Experiment, Parameter, Stage, as_array, neutral
from edgefilter.echo.effects.gain_fit import loudest
from edgefilter.echo.least_squares import normal_equations
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

SHARES = np.array([0.03, 0.06, 0.1, 0.16, 0.24, 0.35, 0.5, 0.7, 1.0])
"""Knots of the curve to either side, re the highest sample: closer where speech has most of its samples."""
EXCERPT = 16 * SAMPLE_RATE
"""Samples that are fitted: the loudest so many, or the first where the model knows what time it is."""
BEYOND = 4.0
"""Full scale: as far as a curve is written down."""
BEND = 1e-4
"""Weight of the curve's second differences, re the mean energy of a knot's part: knots that few samples reach go on as their neighbours do."""


class StaticCurve(Effect):
    """y = f(x), f straight between its knots, f(0) = 0; beyond the last ones it goes on as it ends.

    input, output: (k,) of the knots, full scale. Even and odd parts are free, so that a valve with an offset is such a
    curve as well: the offset itself is not heard.
    """

    name: ClassVar[str] = "static_curve"
    stage: ClassVar[Stage] = "source"
    family: ClassVar[str] = "static nonlinearity"
    title: ClassVar[str] = "a static nonlinearity"
    cost: ClassVar[int] = 2
    complexity: ClassVar[int] = 3
    flexible: ClassVar[bool] = True
    memory: ClassVar[int | None] = 0
    shown_by: ClassVar[tuple[Experiment, ...]] = ("levels", "tone")
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("input", "full scale", 0.0, -4.0, 4.0, given=True),
        Parameter("output", "full scale", 0.0, -40.0, 40.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """The curve at each sample of x (n,)."""
        knots, heights = (np.ravel(values[name]).astype(float) for name in ("input", "output"))
        return x.copy() if knots.size < 2 else drawn(x, knots, heights[:, None])[0]

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Least squares in the heights of the knots, each knot's part of the curve heard through the path."""
        part = slice(0, EXCERPT) if model.timed else loudest(measurement.reference, EXCERPT)
        x, fit = measurement.reference[part], measurement.weights[part] > 0.0
        if part.start:  # what was said before still sounds
            fit[: SAMPLE_RATE // 2] = False
        peak = float(np.max(np.abs(x[fit]), initial=0.0))
        if peak <= 0.0:
            return neutral(self)
        knots = peak * np.concatenate((-SHARES[::-1], [0.0], SHARES))
        parts = drawn(x, knots, np.delete(np.eye(knots.size), SHARES.size, axis=1))
        heard = [measurement.whiten(model.predict(each)) for each in parts]
        normal = normal_equations(heard, measurement.whiten(measurement.recording[part]), 1, 0, fit)
        heights = np.insert(_bent_little(normal.matrix, normal.right, knots), SHARES.size, 0.0)
        return {"input": np.clip(knots, -4.0, 4.0), "output": np.clip(heights, -40.0, 40.0)}

    def sentence(self, values: Values) -> str:
        """How much less the curve gives at its ends than in its middle, and how much more to one side than to the other."""
        knots, heights = (np.ravel(values[name]).astype(float) for name in ("input", "output"))
        if knots.size < 3:
            return "the curve is straight"
        slope = heights / np.where(knots == 0.0, 1.0, knots)
        middle = 0.5 * (slope[knots.size // 2 - 1] + slope[knots.size // 2 + 1])
        high, low = (20.0 * np.log10(max(abs(end / middle), 1e-3)) if middle else 0.0 for end in (slope[-1], slope[0]))
        return (
            f"each sample goes through one curve: at its ends it gives {high:+.1f} dB (upwards) and {low:+.1f} dB"
            " (downwards) of what it gives in its middle"
        )

    def code(self, values: Values) -> str:
        """The curve as a table, drawn on beyond its ends."""
        knots, heights = (np.ravel(values[name]).astype(float) for name in ("input", "output"))
        ends = np.array([-BEYOND, BEYOND])
        beyond = drawn(ends, knots, heights[:, None])[0]
        knots = np.concatenate((ends[:1], knots, ends[1:]))
        heights = np.concatenate((beyond[:1], heights, beyond[1:]))
        return f"""INPUT = {as_array(knots, 4)}
OUTPUT = {as_array(heights, 4)}


def law(x, sample_rate):
    return np.interp(x, INPUT, OUTPUT)"""


def drawn(x: Samples, knots: Array, heights: Array) -> Samples:
    """(m, n) m curves through heights (k, m) at the knots (k,), for the samples x (n,), beyond the last knots straight on."""
    left = np.clip(np.searchsorted(knots, x) - 1, 0, knots.size - 2)
    share = ((x - knots[left]) / (knots[left + 1] - knots[left])).astype(np.float32)
    low, high = heights.T[:, left].astype(np.float32), heights.T[:, left + 1].astype(np.float32)
    return low + share * (high - low)


def _bent_little(matrix: Array, right: Array, knots: Array) -> Array:
    """Heights (k - 1,) of all knots but the middle one, by normal equations and small changes of slope."""
    slopes = np.diff(np.eye(knots.size), axis=0) / np.diff(knots)[:, None]
    bends = np.delete(np.diff(slopes, axis=0) * knots[-1], SHARES.size, axis=1)
    held = bends.T @ bends
    scale = np.trace(matrix) / (np.trace(held) + 1e-30)
    return np.linalg.solve(matrix + BEND * scale * held + 1e-9 * np.diag(matrix.diagonal() + 1e-30), right)
