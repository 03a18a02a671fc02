"""How well the numbers of the found effects are known together: standard errors and correlations, as in a fit report."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from edgefilter.diagnosis.findings import THIRDS_T
from edgefilter.diagnosis.result import Finding, Known, Precision, Source
from edgefilter.diagnosis.trials import Found
from edgefilter.echo.effect import Parameter
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.recording import BLOCK
from edgefilter.errors import UsageError
from edgefilter.types import Array

STEP, LEAST_STEP = 0.1, 1e-4
"""Of the interval's half width, by which a number is moved to see what the prediction makes of it; and of the number
itself: less is lost in float32."""
SMALL = 1e-6
"""Of the fan's power: a number that changes less than that is read off a filter and moves nothing by itself."""
TOLD = 0.1
"""Correlation from which on it is told: less widens neither error by more than 0.5 %."""


def precision(found: Found, findings: Sequence[Finding]) -> Precision:
    """Standard errors and correlations of all numbers of the findings, from the derivatives of the model's prediction.

    Sandwich estimate (White 1980; Liang & Zeger 1986) on the samples that were fitted to, blocks of half a second
    standing for what is independent: speech and fan are neither white nor stationary. Filters of many taps, and the
    numbers that are read off them, stay as they are; these have the scatter of fits to a third of the recording each.
    """
    entries = [
        (finding, parameter, index)
        for finding in findings
        for parameter in find(finding.effect).told
        if parameter.name in finding.parameters
        for index in range(np.size(finding.parameters[parameter.name].value))
    ]
    moved = {i: x for i, entry in enumerate(entries) if (x := _derivative(found, *entry)) is not None}
    covariance = _covariance(found, np.stack(list(moved.values()))) if moved else None
    if covariance is None:
        return Precision(tuple(_known(entry, None) for entry in entries))
    errors = dict(zip(moved, np.sqrt(np.diag(covariance)), strict=True))
    numbers = tuple(_known(entry, errors.get(i)) for i, entry in enumerate(entries))
    shared = []
    for (a, i), (b, j) in combinations(enumerate(moved), 2):
        r = float(covariance[a, b] / (errors[i] * errors[j]))
        if abs(r) >= TOLD:
            shared.append((numbers[i].label, numbers[j].label, r))
    return Precision(numbers, tuple(sorted(shared, key=lambda entry: -abs(entry[2]))))


def _half_width(finding: Finding, parameter: Parameter, index: int) -> float | None:
    """Half the width of a parameter's interval; None where fits to thirds of the recording gave no interval."""
    interval = finding.parameters[parameter.name]
    low, high = (float(np.ravel(bound)[index]) for bound in (interval.low, interval.high))
    return None if (low, high) == (parameter.low, parameter.high) else 0.5 * (high - low)


def _derivative(found: Found, finding: Finding, parameter: Parameter, index: int) -> Array | None:
    """The whitened prediction's derivative by a number, (n,); None at a bound, and where that stays as it is."""
    value = np.array(finding.values[parameter.name], float)
    at = float(value.flat[index])
    if at in (parameter.low, parameter.high):
        return None
    step = max(STEP * (_half_width(finding, parameter, index) or 0.0), LEAST_STEP * abs(at), 1e-9)
    step = step if at + step <= parameter.high else -step
    value.flat[index] = at + step
    measurement = found.in_noise.measurement
    values = {**finding.values, parameter.name: value if value.ndim else float(value)}
    try:
        changed = found.model.with_effect(finding.effect, values).predict(measurement.reference)
    except (UsageError, ArithmeticError):
        return None
    change = measurement.whiten(changed - measurement.predicted(found.model)[0]) * measurement.weights
    if float(np.mean(np.square(change, dtype=np.float64))) < SMALL * (step / max(abs(at), abs(step))) ** 2:
        return None
    return np.asarray(change / step, np.float64)


def _covariance(found: Found, derivatives: Array) -> Array | None:
    """Covariance of numbers with those derivatives (k, n), (k, k); None where they cannot be told apart at all."""
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
    scatter = np.cov(scores) * count if scores.shape[0] > 1 else np.var(scores, ddof=1).reshape(1, 1) * count
    covariance = bread @ scatter @ bread * count / (count - derivatives.shape[0])
    return covariance / scale[:, None] / scale


def _known(entry: tuple[Finding, Parameter, int], error: float | None) -> Known:
    finding, parameter, index = entry
    value = float(np.ravel(finding.parameters[parameter.name].value)[index])
    source: Source = "jacobian"
    if value in (parameter.low, parameter.high):
        error, source = None, "at its bound"
    elif error is None:
        half = _half_width(*entry)
        error, source = (half / (THIRDS_T * np.sqrt(3.0)), "thirds") if half else (None, "none")
    error = None if error is None else float(error)
    return Known(finding.effect, parameter.name, index, value, parameter.unit, error, source)
