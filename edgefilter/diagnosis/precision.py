"""How well the numbers of the found effects are known: standard errors, correlations and 90 % intervals, as in a fit report."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple, TypeAlias

import numpy as np

from edgefilter.diagnosis.result import Interval, Known, Precision, Source
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effect import Parameter
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from edgefilter.echo.recording import BLOCK
from edgefilter.errors import UsageError
from edgefilter.types import Array

MOST = 8
"""A parameter of more numbers is a curve or a filter, of which no number has an interval."""
STEP = 1e-3
"""Relative step of the numerical derivatives: the share of a number by which it is changed. Rounding to float32 is a ten-thousandth of it."""
TOLD = 0.1
"""Correlation from which on it is told: less widens neither error by more than 0.5 %."""
T = 1.7
"""90 % quantile of Student's t with as many degrees of freedom as some ten to thirty seconds have blocks to fit to; over the square root
of 3, that with 2: of three fits to a third each."""
Spread: TypeAlias = tuple[float | None, Source, float, float]
"""How well a number is known: its standard error, the method that gave it, and how far below and above it the 90 % interval ends."""


class Number(NamedTuple):
    """One fitted number: the step of the search that added its effect, the parameter, and the index in that parameter."""

    step: Trial
    parameter: Parameter
    place: int

    @property
    def value(self) -> float:
        """As fitted."""
        return float(np.ravel(self.step.values[self.parameter.name])[self.place])


def precision(
    found: Found, progress: Callable[[str], None] | None = None
) -> tuple[Precision, dict[str, dict[str, Interval]], list[str]]:
    """Standard errors and correlations of all numbers that were found, the interval of each by effect and parameter, and what is not known.

    From the derivatives of the model's prediction. Sandwich estimate (White 1980; Liang & Zeger 1986) on the samples that were
    fitted to, blocks of half a second standing for what is independent: speech and fan are neither white nor stationary. A fit may end
    short of the least error, by more than chance moves that: the interval reaches from the value to where a Gauss-Newton step would
    lead (Le Cam 1956, the one-step estimator), and beyond both by chance. An effect that has a filter of many taps as well, or a number
    that moves nothing since it is read off, has the scatter of fits to a third of the recording each.
    """
    told = [(step, parameter) for step in found.steps for parameter in find(step.name).told]
    sizes = [np.size(step.values[parameter.name]) for step, parameter in told]
    numbers = [Number(*one, i) for one, size in zip(told, sizes, strict=True) if size <= MOST for i in range(size)]
    ended = (i for i, n in enumerate(numbers) if n.value in (n.parameter.low, n.parameter.high))
    spreads: dict[int, Spread] = {i: (None, "at its bound", 0.0, 0.0) for i in ended}
    shared, doubts = _by_derivatives(found, numbers, spreads), _by_thirds(found, numbers, spreads, progress)
    known = [
        Known(n.step.name, n.parameter.name, n.place, n.value, n.parameter.unit, *spreads[i][:2])
        for i, n in enumerate(numbers)
    ]
    correlations = tuple((known[i].label, known[j].label, r) for i, j, r in shared)
    return Precision(tuple(known), correlations), _intervals(numbers, spreads), doubts


def _by_derivatives(found: Found, numbers: list[Number], spreads: dict[int, Spread]) -> list[tuple[int, int, float]]:
    """Add the spreads of the numbers that the prediction's derivatives tell; the correlations that are told, the closest first."""
    few = {step.name for step in found.steps if max(map(np.size, step.values.values()), default=0) <= MOST}
    free = (i for i, number in enumerate(numbers) if i not in spreads and number.step.name in few)
    moved = {i: x for i in free if (x := _derivative(found, numbers[i])) is not None}
    solved = _solved(found, np.stack(list(moved.values()))) if moved else None
    if solved is None:
        return []
    errors = np.sqrt(np.diag(solved[0]))
    for i, error, step in zip(moved, errors.tolist(), solved[1].tolist(), strict=True):
        spreads[i] = error, "jacobian", T * error - min(step, 0.0), T * error + max(step, 0.0)
    alike = solved[0] / errors / errors[:, None]
    pairs = ((i, j, float(alike[a, b])) for (a, i), (b, j) in combinations(enumerate(moved), 2))
    return sorted((pair for pair in pairs if abs(pair[2]) >= TOLD), key=lambda pair: -abs(pair[2]))


def _by_thirds(
    found: Found, numbers: list[Number], spreads: dict[int, Spread], progress: Callable[[str], None] | None
) -> list[str]:
    """Add the spreads that are left, from fits to thirds; why one of these failed."""
    doubts: list[str] = []
    for one in found.steps:
        if left := [i for i, number in enumerate(numbers) if number.step is one and i not in spreads]:
            if progress:
                progress(f"how well {one.name} is known")
            fits = _thirds(found, one, doubts)
            spreads |= {i: _scatter(numbers[i], fits) for i in left}
    return doubts


def _intervals(numbers: list[Number], spreads: dict[int, Spread]) -> dict[str, dict[str, Interval]]:
    """Of each effect and parameter, within its bounds."""
    intervals: dict[str, dict[str, Interval]] = {}
    for i, (trial, parameter, place) in enumerate(numbers):
        if place == 0:
            value = np.asarray(trial.values[parameter.name], float)
            below, above = np.array([spreads[i + k][2:] for k in range(value.size)]).T.reshape(2, *value.shape)
            low, high = np.clip((value - below, value + above), parameter.low, parameter.high)
            intervals.setdefault(trial.name, {})[parameter.name] = Interval.of(value, low, high, parameter.unit)
    return intervals


def _derivative(found: Found, number: Number) -> Array | None:
    """The whitened prediction's derivative by a number, (n,); None where that stays as it is."""
    step, parameter, index = number
    value, at = np.array(step.values[parameter.name], float), number.value
    by = STEP * (abs(at) or 1.0)
    by = by if at + by <= parameter.high else -by
    value.flat[index] = at + by
    measurement = found.in_noise.measurement
    values = {**step.values, parameter.name: value if value.ndim else float(value)}
    try:
        changed = found.model.with_effect(step.name, values).predict(measurement.reference)
    except (UsageError, ArithmeticError):
        return None
    change = measurement.whiten(changed - measurement.predicted(found.model)[0]) * measurement.weights
    return np.asarray(change / by, np.float64) if change.any() else None


def _solved(found: Found, derivatives: Array) -> tuple[Array, Array] | None:
    """Covariance (k, k) of numbers with those derivatives (k, n), and the Gauss-Newton step of each, (k,); None where they cannot be told apart."""
    measurement = found.in_noise.measurement
    residual = (measurement.white_recording - measurement.predicted(found.model)[1]) * measurement.weights
    scale = np.sqrt(np.sum(derivatives**2, axis=1))
    unit = derivatives / scale[:, None]
    curvature = unit @ unit.T
    if np.linalg.cond(curvature) > 1e10:
        return None
    edges = np.arange(0, residual.size, BLOCK)
    scores = np.add.reduceat(unit * residual, edges, axis=1)
    scores = scores[:, np.add.reduceat(measurement.weights, edges) > 0.0]
    count = scores.shape[1]
    if count <= derivatives.shape[0] + 1:
        return None
    bread = np.linalg.inv(curvature)
    scatter = np.atleast_2d(np.cov(scores)) * count
    covariance = bread @ scatter @ bread * count / (count - derivatives.shape[0])
    return covariance / scale[:, None] / scale, bread @ scores.sum(axis=1) / scale


def _thirds(found: Found, step: Trial, doubts: list[str]) -> list[Values]:
    """The values of an effect fitted to each third of the recording; doubts gets why that failed."""
    block = np.arange(found.recording.usable.size) // BLOCK
    fits: list[Values] = []
    for third in range(3):
        part = found.recording.fitted_to(found.recording.usable & (block % 3 == third))
        try:
            fits.append(part.fitted(step.name, found.model.without_effect(step.name)))
        except (UsageError, ArithmeticError, np.linalg.LinAlgError) as error:
            told = f"how well {step.name} is known is told by fits to a third of the recording each"
            doubts.append(f"{told}, and one failed: {error}")
    return fits


def _scatter(number: Number, fits: list[Values]) -> Spread:
    """The interval from the scatter of fits to thirds and how far their mean is from the fitted number; infinite for fewer than two fits."""
    if len(fits) < 2:
        return None, "none", np.inf, np.inf
    alike = [np.asarray(fit[number.parameter.name], float) for fit in fits]
    shape = np.shape(number.step.values[number.parameter.name])
    here = [float(fit.flat[number.place]) for fit in alike if fit.shape == shape]
    half = float(np.hypot(T * np.std(here, ddof=1), np.mean(here) - number.value)) if len(here) > 1 else 0.0
    return (half / (T * np.sqrt(3.0)), "thirds", half, half) if half else (None, "none", 0.0, 0.0)
