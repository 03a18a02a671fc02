"""The fit of an effect that turns the reference down by its own level: thresholds, ratios and times, by Gauss-Newton."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from edgefilter.dsp.frames import block_power, decibels
from edgefilter.echo.least_squares import RIDGE, at_lags, ridge_solved
from edgefilter.echo.measurement import Measurement, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

EXCERPT = 8 * SAMPLE_RATE
"""Samples of the stretch that is fitted."""
TAPS = 8
"""Of the nuisance filter on each part of the prediction, half of them ahead: what is linear, the make-up gain included."""
ITERATIONS, SETTLED = 6, 1e-3
"""Steps at most; one that lowers the cost by less than this part of it is the last."""
DAMPINGS = (1e-4, 1e-2, 0.3)
"""Of a step, re the energy of what each unknown changes: tried until one lowers the cost."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Of each unknown (k,), the first a level in dB: the step of its numerical derivative, the longest of the fit, its bounds."""

    nudge: Array
    longest: Array
    lowest: Array
    highest: Array


class GainFit:
    """Unknowns (k,) with which make(reference, unknowns), a few signals, each through a short filter, explain a recording.

    loud_db: level of the loudest 20 ms of the excerpt. without: energy that the reference itself leaves of it.
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
        self.without = self._left([self._heard(self._x)])

    def best(self, starts: Sequence[Array]) -> tuple[Array, float] | None:
        """The unknowns that leave least, and that energy; None where they do not pay for themselves by Bayes' criterion (Schwarz 1978)."""
        starts = [np.clip(start, self._reach.lowest, self._reach.highest) for start in starts]
        costs = [self.cost(start) for start in starts]
        best, cost = starts[int(np.argmin(costs))], min(costs)
        for _ in range(ITERATIONS if self.loud_db > self._reach.lowest[0] and cost < self.without else 0):
            best, now = self._step(best, cost)
            settled, cost = now > cost * (1.0 - SETTLED), now
            if settled:
                break
        count = max(self._chosen.size, 2)
        worth = best.size * np.log(count) * cost / count
        return (best, cost) if self.without - cost > worth else None

    def cost(self, unknowns: Array) -> float:
        """Energy that these unknowns leave of the excerpt."""
        return self._left(self._parts(unknowns))

    def gains(self, unknowns: Array) -> Array:
        """Least-squares gain of each part over the whole recording, (parts,)."""
        measurement = self._measurement
        parts = [measurement.whiten(self._model.predict(part)) for part in self._make(measurement.reference, unknowns)]
        rows = np.stack(parts, axis=1) * measurement.weights[:, None]
        normal, right = (rows.T @ rows).astype(float), (rows.T @ measurement.white_recording).astype(float)
        return np.linalg.solve(normal + RIDGE * np.trace(normal) * np.eye(right.size) + 1e-30, right)

    def _heard(self, sound: Samples) -> Samples:
        return self._measurement.whiten(self._model.predict(sound))

    def _parts(self, unknowns: Array) -> list[Samples]:
        return [self._heard(part) for part in self._make(self._x, unknowns)]

    def _rows(self, parts: Sequence[Samples]) -> Samples:
        """Each part at its lags, (chosen, parts * TAPS)."""
        return np.concatenate([at_lags(part, TAPS, TAPS // 2)[self._chosen] for part in parts], axis=1)

    def _solved(self, rows: Samples, ridge: Array | float) -> Samples:
        """Least-squares weights of rows (chosen, k), (k,); ridge is relative to each one's own energy."""
        normal, right = (rows.T @ rows).astype(float), (rows.T @ self._target).astype(float)
        return np.float32(ridge_solved(normal, right, ridge))

    def _left(self, parts: Sequence[Samples]) -> float:
        rows = self._rows(parts)
        residual = self._target - rows @ self._solved(rows, RIDGE)
        return float(np.dot(residual, residual))

    def _step(self, at: Array, cost: float) -> tuple[Array, float]:
        """One step, damped and shortened until it helps (Levenberg 1944); the unknowns and the cost that it reaches."""
        parts = self._parts(at)
        base = self._rows(parts)
        gains = self._solved(base, RIDGE).reshape(len(parts), TAPS).sum(axis=1)
        nudge = np.where(at + self._reach.nudge > self._reach.highest, -self._reach.nudge, self._reach.nudge)

        def whole(unknowns: Array) -> Samples:
            return np.float32(gains) @ np.stack(self._make(self._x, unknowns))

        here = whole(at)
        moved = [whole(at + nudge * unit) - here for unit in np.eye(at.size)]
        changes = np.stack([self._heard(change)[self._chosen] for change in moved], axis=1)
        rows = np.concatenate((base, changes), axis=1)
        for damping in DAMPINGS:
            ridge = np.concatenate((np.full(base.shape[1], RIDGE), np.full(at.size, damping)))
            wanted = self._solved(rows, ridge)[base.shape[1] :] * nudge
            step = np.clip(wanted, -self._reach.longest, self._reach.longest)
            for shorter in (1.0, 0.3):
                there = np.clip(at + shorter * step, self._reach.lowest, self._reach.highest)
                now = self.cost(there)
                if now < cost:
                    return there, now
        return at, cost


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
