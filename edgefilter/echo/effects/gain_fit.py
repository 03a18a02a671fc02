"""The fit of an effect that turns the reference down by its own level: thresholds, ratios and times, by separable least squares."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from edgefilter.dsp.frames import block_power, decibels
from edgefilter.echo.effect import Effect, complete, neutral, within
from edgefilter.echo.least_squares import RIDGE, at_lags
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

EXCERPT = 8 * SAMPLE_RATE
"""Samples of the stretch that is fitted."""
TAPS = 8
"""Of the nuisance filter on each part of the prediction, half of them ahead: what is linear, the make-up gain included."""
SETTLED = 1e-3
"""A step of the solver that lowers the cost by less than this part of it is the last."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Of each unknown (k,), the first a level in dB: the step of its numerical derivative, and its bounds."""

    nudge: Array
    lowest: Array
    highest: Array


class GainFit:
    """Unknowns (k,) with which make(reference, unknowns), a few signals, each through a short filter, explain a recording.

    The filters are solved for at each step (Golub & Pereyra 1973, "variable projection"). loud_db: level of the loudest 20 ms
    of the excerpt. without: energy that the reference itself leaves of it.
    """

    def __init__(
        self,
        measurement: Measurement,
        model: VoiceModel,
        make: Callable[[Samples, Array], Sequence[Samples]],
        reach: Reach,
    ) -> None:
        self._measurement, self._model, self._make, self._reach = measurement, model, make, reach
        part = excerpt(measurement, model, EXCERPT)
        chosen = measurement.weights[part] > 0.0
        if part.start:
            chosen[: SAMPLE_RATE // 2] = False  # in it the level settles
        self._x, self._chosen = measurement.reference[part], np.flatnonzero(chosen)
        self._target = measurement.whiten(measurement.recording[part])[self._chosen]
        self.loud_db = float(decibels(np.max(block_power(self._x, SAMPLE_RATE // 50), initial=0.0), 1e-9))
        left = self._left([self._x])
        self.without = float(left @ left)

    def best(self, starts: Sequence[Array]) -> tuple[Array, float] | None:
        """The unknowns that leave least, and that energy; None where they do not pay for themselves by Bayes' criterion (Schwarz 1978)."""
        reach = self._reach
        starts = [np.clip(start, reach.lowest, reach.highest) for start in starts]
        costs = [self.cost(start) for start in starts]
        best, cost = starts[int(np.argmin(costs))], min(costs)
        if self.loud_db > reach.lowest[0] and cost < self.without:
            edge = 1e-3 * reach.nudge  # the solver begins inside of its bounds
            solved = scipy.optimize.least_squares(
                self._residual,
                np.clip(best, reach.lowest + edge, reach.highest - edge),
                self._slopes,
                (reach.lowest, reach.highest),
                x_scale=reach.nudge,
                ftol=SETTLED,
            )
            best, cost = solved.x, 2.0 * solved.cost
        count = max(self._chosen.size, 2)
        worth = best.size * np.log(count) * cost / count
        return (best, cost) if self.without - cost > worth else None

    def cost(self, unknowns: Array) -> float:
        """Energy that these unknowns leave of the excerpt."""
        left = self._residual(unknowns)
        return float(left @ left)

    def gains(self, unknowns: Array) -> Array:
        """Least-squares gain of each part over the whole recording, (parts,)."""
        measurement = self._measurement
        parts = [measurement.heard(self._model, part) for part in self._make(measurement.reference, unknowns)]
        rows = np.stack(parts, axis=1) * measurement.weights[:, None]
        normal, right = (rows.T @ rows).astype(float), (rows.T @ measurement.white_recording).astype(float)
        return np.linalg.solve(normal + RIDGE * np.trace(normal) * np.eye(right.size) + 1e-30, right)

    def _residual(self, unknowns: Array) -> Samples:
        return self._left(self._make(self._x, unknowns))

    def _slopes(self, unknowns: Array) -> Array:
        """Derivatives of the residual, (chosen, k), the filters taken to move what is explained, not how (Kaufman 1975)."""
        reach, sounds = self._reach, self._make(self._x, unknowns)
        rows = self._rows(sounds)
        gains = self._weights(rows, self._target).reshape(len(sounds), TAPS).sum(axis=1)
        steps = np.where(unknowns + reach.nudge > reach.highest, -reach.nudge, reach.nudge)
        here, moved = gains @ np.stack(sounds), np.empty((self._chosen.size, steps.size), np.float32)
        for column, step, unit in zip(moved.T, steps, np.eye(steps.size), strict=True):
            there = gains @ np.stack(self._make(self._x, unknowns + step * unit))
            column[:] = self._heard((there - here) / np.float32(step))[self._chosen]
        return rows @ self._weights(rows, moved) - moved

    def _left(self, sounds: Sequence[Samples]) -> Samples:
        """What the sounds, each through the filter of TAPS that is best, leave of the excerpt, (chosen,)."""
        rows = self._rows(sounds)
        return self._target - rows @ self._weights(rows, self._target)

    def _heard(self, sound: Samples) -> Samples:
        return self._measurement.heard(self._model, sound)

    def _rows(self, sounds: Sequence[Samples]) -> Samples:
        """Each sound as it is heard, at its lags, (chosen, sounds * TAPS)."""
        return np.concatenate([at_lags(self._heard(x), TAPS, TAPS // 2)[self._chosen] for x in sounds], axis=1)

    def _weights(self, rows: Samples, target: Samples) -> Samples:
        """Least-squares weights of rows (chosen, k) for a target (chosen,), or several (chosen, m)."""
        normal = (rows.T @ rows).astype(float)
        normal[np.diag_indices_from(normal)] *= 1.0 + RIDGE
        return np.float32(np.linalg.solve(normal + 1e-30 * np.eye(len(normal)), (rows.T @ target).astype(float)))


def fit_one(
    effect: Effect,
    measurement: Measurement,
    model: VoiceModel,
    values_of: Callable[[Array], Values],
    reach: Reach,
    starts: Iterable[Sequence[float]],
) -> Values:
    """Values of an effect with make-up gain from the best of some starts, in unknowns, the level re the loudest 20 ms; neutral where none pays."""

    def turned(x: Samples, unknowns: Array) -> tuple[Samples]:
        return (effect.apply(x, complete(effect, values_of(unknowns)), SAMPLE_RATE),)

    fit = GainFit(measurement, model, turned, reach)
    found = fit.best([np.array((fit.loud_db + above, *others)) for above, *others in starts])
    if found is None:
        return neutral(effect)
    makeup_db = 20.0 * np.log10(max(float(fit.gains(found[0])[0]), 1e-2))
    return within(effect, {**values_of(found[0]), "makeup_db": makeup_db})


def excerpt(measurement: Measurement, model: VoiceModel, size: int) -> slice:
    """The loudest stretch of so many samples of the reference, or the first one where the model knows what time it is.

    Of those of which about as much may be fitted to as of any.
    """
    x = measurement.reference
    if model.timed or x.size <= size:
        return slice(0, size)
    sums = (np.cumsum(np.pad(each, (1, 0)), dtype=np.float64) for each in (np.square(x), measurement.weights > 0.0))
    energy, fitted = (total[size:] - total[:-size] for total in sums)
    start = int(np.argmax(np.where(2.0 * fitted >= fitted.max(), energy, -1.0)))
    return slice(start, start + size)
