"""How well the numbers of the found effects are known: standard errors, correlations and 90 % intervals, as in a fit report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
"""Numbers of one parameter that are told: more are a curve."""
STEP, LEAST_STEP = 1e-3, 1e-6
"""Of a number, by which it is moved to see what the prediction makes of it: float32 holds it to a thousandth of that; and the least."""
SMALL = 1e-6
"""Of the fan's power: a number that changes less than that is read off a filter and moves nothing by itself."""
TOLD = 0.1
"""Correlation from which on it is told: less widens neither error by more than 0.5 %."""
T = 1.7
"""90 % quantile of Student's t with as many degrees of freedom as some ten to thirty seconds have blocks to fit to."""
THIRDS_T = 1.69
"""The same with 2 degrees of freedom, over the square root of 3: of three fits to a third each."""


class Number(NamedTuple):
    """One number of a step of the search: of that parameter, at that place in it."""

    step: Trial
    parameter: Parameter
    place: int

    @property
    def value(self) -> float:
        """As fitted."""
        return float(np.ravel(self.step.values[self.parameter.name])[self.place])

    @property
    def label(self) -> str:
        """As Known.label."""
        return Known(self.step.name, self.parameter.name, self.place, 0.0, "", None, "none").label

    def around(self, below: float, above: float) -> tuple[float, float]:
        """Both ends of an interval around the value, within the parameter's bounds."""
        return max(self.value + below, self.parameter.low), min(self.value + above, self.parameter.high)

    @property
    def bound(self) -> bool:
        """Whether it could not go farther."""
        return self.value in (self.parameter.low, self.parameter.high)


Spread: TypeAlias = tuple[float | None, Source, float, float]
"""Of a number: standard error, where that is from, and both ends of its 90 % interval."""


def precision(
    found: Found, progress: Callable[[str], None] | None = None
) -> tuple[Precision, dict[str, dict[str, Interval]], list[str]]:
    """Standard errors and correlations of all numbers that were found, the interval of each by effect and parameter, and what is not known.

    From the derivatives of the model's prediction. Sandwich estimate (White 1980; Liang & Zeger 1986) on the samples that were
    fitted to, blocks of half a second standing for what is independent: speech and fan are neither white nor stationary. A fit may end
    short of the least error, by more than chance moves that: the interval reaches from the value to where a Gauss-Newton step would
    lead (Le Cam 1956, the one-step estimator), and beyond both by chance. Filters of many taps stay as they are; numbers that are read off
    them move nothing, and have the scatter of fits to a third of the recording each.
    """
    numbers = [
        Number(step, parameter, index)
        for step in found.steps
        for parameter in find(step.name).told
        if np.size(step.values[parameter.name]) <= MOST
        for index in range(np.size(step.values[parameter.name]))
    ]
    moved = {i: x for i, number in enumerate(numbers) if (x := _derivative(found, number)) is not None}
    spreads: dict[int, Spread] = {i: (None, "at its bound", n.value, n.value) for i, n in enumerate(numbers) if n.bound}
    correlations = []
    if solved := _solved(found, np.stack(list(moved.values()))) if moved else None:
        errors = np.sqrt(np.diag(solved[0]))
        for i, error, step in zip(moved, errors.tolist(), solved[1].tolist(), strict=True):
            spreads[i] = (error, "jacobian", *numbers[i].around(min(step, 0.0) - T * error, max(step, 0.0) + T * error))
        for (a, i), (b, j) in combinations(enumerate(moved), 2):
            if abs(r := float(solved[0][a, b] / (errors[a] * errors[b]))) >= TOLD:
                correlations.append((numbers[i].label, numbers[j].label, r))
    doubts: list[str] = []
    for one in found.steps:
        if left := {i: number for i, number in enumerate(numbers) if number.step is one and i not in spreads}:
            if progress:
                progress(f"how well {one.name} is known")
            fits, failed = _thirds(found, one)
            spreads |= {i: _scatter(number, fits) for i, number in left.items()}
            doubts += failed
    known = [
        Known(n.step.name, n.parameter.name, n.place, n.value, n.parameter.unit, *spreads[i][:2])
        for i, n in enumerate(numbers)
    ]
    shared = tuple(sorted(correlations, key=lambda entry: -abs(entry[2])))
    return Precision(tuple(known), shared), _intervals(numbers, spreads), doubts


def _derivative(found: Found, number: Number) -> Array | None:
    """The whitened prediction's derivative by a number, (n,); None at a bound, and where that stays as it is."""
    step, parameter, index = number
    value, at = np.array(step.values[parameter.name], float), number.value
    if number.bound:
        return None
    by = max(STEP * abs(at), LEAST_STEP)
    by = by if at + by <= parameter.high else -by
    value.flat[index] = at + by
    measurement = found.in_noise.measurement
    values = {**step.values, parameter.name: value if value.ndim else float(value)}
    try:
        changed = found.model.with_effect(step.name, values).predict(measurement.reference)
    except (UsageError, ArithmeticError):
        return None
    change = measurement.whiten(changed - measurement.predicted(found.model)[0]) * measurement.weights
    if float(np.mean(np.square(change, dtype=np.float64))) < SMALL * (by / max(abs(at), abs(by))) ** 2:
        return None
    return np.asarray(change / by, np.float64)


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


def _thirds(found: Found, step: Trial) -> tuple[list[Values], list[str]]:
    """The values of an effect fitted to each third of the recording, and why that failed."""
    recording, others = found.recording, found.model.without_effect(step.name)
    block = np.arange(recording.usable.size) // BLOCK
    fits: list[Values] = []
    failed = []
    for third in range(3):
        try:
            fits.append(recording.fitted_to(recording.usable & (block % 3 == third)).fitted(step.name, others))
        except (UsageError, ArithmeticError, np.linalg.LinAlgError) as error:
            failed.append(
                f"how well {step.name} is known is told by fits to a third of the recording each, and one failed:"
                f" {error}"
            )
    return fits, failed


def _scatter(number: Number, fits: list[Values]) -> Spread:
    """From the scatter of fits and from how far their mean is off: a number is known no better than that. Anywhere where fewer than two were made."""
    if len(fits) < 2:
        return None, "none", number.parameter.low, number.parameter.high
    alike = [np.asarray(fit[number.parameter.name], float) for fit in fits]
    shape = np.shape(number.step.values[number.parameter.name])
    here = [float(fit.flat[number.place]) for fit in alike if fit.shape == shape]
    half = float(np.hypot(THIRDS_T * np.std(here, ddof=1), np.mean(here) - number.value)) if len(here) > 1 else 0.0
    error = half / (THIRDS_T * np.sqrt(3.0))
    return (error, "thirds", *number.around(-half, half)) if half else (None, "none", number.value, number.value)


def _intervals(numbers: list[Number], spreads: Mapping[int, Spread]) -> dict[str, dict[str, Interval]]:
    """The interval of each parameter, by effect."""
    found: dict[str, dict[str, Interval]] = {}
    for i, (step, parameter, place) in enumerate(numbers):
        if place == 0:
            value = np.asarray(step.values[parameter.name], float)
            low, high = np.array([spreads[i + k][2:] for k in range(value.size)]).T.reshape(2, *value.shape)
            found.setdefault(step.name, {})[parameter.name] = Interval.of(value, low, high, parameter.unit)
    return found
