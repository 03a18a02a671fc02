"""The fit of an effect that turns the reference down by its own level: thresholds, ratios and times, by separable least squares."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.frames import block_power, block_sums, blocks, decibels
from edgefilter.echo.effect import Effect, complete, neutral, within
from edgefilter.echo.least_squares import RIDGE, at_lags
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

EXCERPT = 8 * SAMPLE_RATE
"""Samples of the stretch that is fitted."""
STEP = 16
"""Samples (1 ms) between two values of a level, or of a gain over time."""
TAPS = 8
"""Of the nuisance filter on each part of the prediction, half of them ahead: what is linear, the make-up gain included."""
SETTLED = 1e-3
"""A step of the solver that lowers the cost by less than this part of it, or is less than a tenth of it of the unknowns, is the last."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Of each unknown (k,), the first a level in dB: the step of its numerical derivative, and its bounds."""

    nudge: Array
    lowest: Array
    highest: Array

    def moved(self, unknowns: Array) -> Iterator[tuple[Array, np.float32]]:
        """The unknowns (k,) with each of them moved in turn, and by how much."""
        for place, step in enumerate(np.where(unknowns + self.nudge > self.highest, -self.nudge, self.nudge)):
            there = unknowns.copy()
            there[place] += step
            yield there, np.float32(step)

    def solved(
        self, residual: Callable[[Array], Array], slopes: Callable[[Array], Array], start: Array
    ) -> tuple[Array, float]:
        """Solve for the unknowns with the smallest residual, given its derivatives (slopes); the unknowns, and the energy of what they leave."""
        edge = 1e-3 * self.nudge  # the solver begins inside of its bounds
        start, bounds = np.clip(start, self.lowest + edge, self.highest - edge), (self.lowest, self.highest)
        settled = {"ftol": SETTLED, "xtol": 0.1 * SETTLED}
        found = scipy.optimize.least_squares(residual, start, slopes, bounds, x_scale=self.nudge, **settled)
        return found.x, 2.0 * float(found.cost)


class GainFit:
    """Fits unknowns (k,): make(reference, unknowns) gives a few signals whose sum, each through a short filter, is to explain a recording.

    The filters are solved for at each step (Golub & Pereyra 1973, "variable projection"). x: the excerpt of the reference.
    loud_db: level of its loudest 20 ms. without: energy of the residual if the reference itself is the only signal.
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
        self.x, self._chosen = measurement.reference[part], np.flatnonzero(chosen)
        self._target = measurement.whiten(measurement.recording[part])[self._chosen]
        self.loud_db = float(decibels(np.max(block_power(self.x, SAMPLE_RATE // 50), initial=0.0), 1e-9))
        self._latest: tuple[Array, tuple[Sequence[Samples], Samples, Samples]] | None = None
        rows = self._rows([self.x])
        left = self._target - rows @ self._weights(rows, self._target)
        self.without, self._heard_plain = float(left @ left), self._target - left

    def best(self, starts: Sequence[Array]) -> Array | None:
        """The unknowns with the smallest residual; None if they lower its energy by less than Bayes' criterion asks (Schwarz 1978)."""
        reach = self._reach
        starts = [np.clip(start, reach.lowest, reach.highest) for start in starts]
        costs = [float(left @ left) for left in map(self._residual, starts)]
        best, cost = starts[int(np.argmin(costs))], min(costs)
        if self.loud_db > reach.lowest[0] and cost < self.without:
            best, cost = reach.solved(self._residual, self._slopes, best)
        count = max(self._chosen.size, 2)
        worth = best.size * np.log(count) * cost / count
        return best if self.without - cost > worth else None

    def roughly(self, gain: Callable[[Array], Array], starts: Sequence[Array]) -> list[Array]:
        """The best of some starts, and the same after a quick least-squares fit of one gain per STEP; gain(unknowns): (steps,).

        Quick, since the echo path is kept at the filter that fits best without any gain, and each STEP of sound is taken to arrive
        within itself.
        """
        pairs = self._heard_plain**2, self._heard_plain * self._target
        whole = np.zeros((2, self.x.size + PRE_ROLL))
        whole[:, self._chosen] = pairs
        used, target = (block_sums(each[PRE_ROLL:], STEP) for each in whole)
        root = np.sqrt(used + 1e-12 * used.mean() + 1e-30)
        target /= root

        def left(unknowns: Array) -> Array:
            row = root * gain(unknowns)
            return target - row * (float(row @ target) / (float(row @ row) + 1e-30))

        def slopes(unknowns: Array) -> Array:
            here = left(unknowns)
            return np.stack([(left(there) - here) / step for there, step in self._reach.moved(unknowns)], axis=1)

        starts = [np.clip(start, self._reach.lowest, self._reach.highest) for start in starts]
        best = min(starts, key=lambda start: float(np.sum(left(start) ** 2)))
        return [best, self._reach.solved(left, slopes, best)[0]]

    def gains(self, unknowns: Array) -> Array:
        """Least-squares gain of each part over the whole recording, (parts,)."""
        measurement = self._measurement
        parts = [measurement.heard(self._model, part) for part in self._make(measurement.reference, unknowns)]
        rows = np.stack(parts, axis=1) * measurement.weights[:, None]
        normal, right = (rows.T @ rows).astype(float), (rows.T @ measurement.white_recording).astype(float)
        return np.linalg.solve(normal + RIDGE * np.trace(normal) * np.eye(right.size) + 1e-30, right)

    def _residual(self, unknowns: Array) -> Samples:
        _, rows, weights = self._filtered(unknowns)
        return self._target - rows @ weights

    def _filtered(self, unknowns: Array) -> tuple[Sequence[Samples], Samples, Samples]:
        """Sounds of the law with these unknowns, their delayed copies (rows) and the best filters of TAPS taps.

        The latest are kept, since the solver asks for slopes where it has just asked for the residual.
        """
        if self._latest is None or not np.array_equal(self._latest[0], unknowns):
            sounds = self._make(self.x, unknowns)
            rows = self._rows(sounds)
            self._latest = unknowns.copy(), (sounds, rows, self._weights(rows, self._target))
        return self._latest[1]

    def _slopes(self, unknowns: Array) -> Array:
        """Derivatives of the residual, (chosen, k), with those of the filters approximated as Kaufman (1975) does."""
        sounds, rows, weights = self._filtered(unknowns)
        gains = weights.reshape(len(sounds), TAPS).sum(axis=1)
        here, moved = gains @ np.stack(sounds), np.empty((self._chosen.size, unknowns.size), np.float32)
        for column, (there, step) in zip(moved.T, self._reach.moved(unknowns), strict=True):
            change = (gains @ np.stack(self._make(self.x, there)) - here) / step
            column[:] = self._measurement.heard(self._model, change)[self._chosen]
        return rows @ self._weights(rows, moved) - moved

    def _rows(self, sounds: Sequence[Samples]) -> Samples:
        """Each sound as it is heard, at its lags, (chosen, sounds * TAPS)."""
        heard = (self._measurement.heard(self._model, sound) for sound in sounds)
        return np.concatenate([at_lags(x, TAPS, TAPS // 2)[self._chosen] for x in heard], axis=1)

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
    by_peaks: bool = False,
) -> Values:
    """Fit an effect with make-up gain: the values of the best start after least squares, or neutral ones if none is worth its numbers.

    starts: of the unknowns; the first is a level in dB above the loudest 20 ms. by_peaks: whether the effect follows the peaks
    rather than the mean square.
    """

    def turned(x: Samples, unknowns: Array, sample_rate: int = SAMPLE_RATE) -> tuple[Samples]:
        return (effect.apply(x, complete(effect, values_of(unknowns)), sample_rate),)

    fit = GainFit(measurement, model, turned, reach)
    size = np.abs(blocks(fit.x, STEP))
    amplitude = (size.max(axis=1) if by_peaks else np.sqrt(np.mean(size**2, axis=1))) + 1e-9

    def gain(unknowns: Array) -> Array:
        return turned(amplitude, unknowns, SAMPLE_RATE // STEP)[0] / amplitude

    found = fit.best(fit.roughly(gain, [np.array((fit.loud_db + above, *others)) for above, *others in starts]))
    if found is None:
        return neutral(effect)
    makeup_db = 20.0 * np.log10(max(float(fit.gains(found)[0]), 1e-2))
    return within(effect, {**values_of(found), "makeup_db": makeup_db})


def excerpt(measurement: Measurement, model: VoiceModel, size: int) -> slice:
    """The loudest `size` samples of the reference; the first `size` if an effect of the model depends on the time of the recording."""
    fitted = measurement.weights > 0.0
    return slice(0, size) if model.timed else loudest(measurement.reference, fitted, size)


def loudest(x: Array, fitted: NDArray[np.bool_], size: int) -> slice:
    """The loudest `size` samples of x (n,) among the stretches with at least half as many samples to fit to as the best one."""
    if x.size <= size:
        return slice(0, x.size)
    sums = (np.cumsum(np.pad(each, (1, 0)), dtype=np.float64) for each in (np.square(x), fitted))
    energy, usable = (total[size:] - total[:-size] for total in sums)
    start = int(np.argmax(np.where(2.0 * usable >= usable.max(), energy, -1.0)))
    return slice(start, start + size)
