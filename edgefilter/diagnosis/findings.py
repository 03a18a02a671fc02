"""What a search has found, said of each effect by itself: its part of the excess, its parameters and how well these are known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.result import Finding, Interval
from edgefilter.diagnosis.score import Scorer, share_of
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel
from edgefilter.echo.recording import BLOCK
from edgefilter.errors import UsageError

THIRDS_T = 1.69
"""90 % quantile of Student's t with 2 degrees of freedom over the square root of 3: the interval from three fits to a
third each."""


def findings_of(found: Found, progress: Callable[[str], None] | None) -> tuple[tuple[Finding, ...], list[str]]:
    """The one that is missed most first; each with the excess before and after it in the order of the steps.

    A change of the fan comes first only where it is more than all the rest.

    And what is not known of them.
    """
    findings, doubts, before, scorer = [], [], found.base.excess_db, Scorer(found.prepared)
    for step in found.steps:
        without_db = scorer.of(found.model.without_effect(step.name)).level_db
        after = found.final.excess_db if step is found.steps[-1] else step.score.excess_db
        if progress:
            progress(f"how well {step.name} is known")
        intervals, doubt = _intervals(found.prepared, found.model, step)
        doubts += doubt
        findings.append(
            Finding(
                effect=step.name,
                family=find(step.name).family,
                p_value=min(step.p_value, p_value(step.name, without_db - found.final.level_db)),
                excess_before_db=before,
                excess_after_db=after,
                share=max(share_of(found.base.excess_db, after) - share_of(found.base.excess_db, before), 0.0),
                parameters=intervals,
                evidence=find(step.name).sentence(step.values)
                or f"with {step.name} the held-out residual falls by {step.gain_db:.2f} dB",
                values=step.values,
                prediction=step.score.prediction,
            )
        )
        before = after
    voice, noise = ([f for f in findings if (find(f.effect).stage == "noise") is fan] for fan in (False, True))
    first = noise and sum(f.share for f in noise) > sum(f.share for f in voice)
    return tuple((*noise, *voice) if first else (*voice, *noise)), doubts


def _intervals(prepared: Prepared, model: EchoModel, step: Trial) -> tuple[Mapping[str, Interval], list[str]]:
    """Each scalar parameter, or short list, with the interval that three fits to a third of the recording each give.

    And which fits failed.

    Where fewer than two thirds can be fitted, a parameter may have any of its possible values.
    """
    effect = find(step.name)
    block = np.arange(prepared.usable.size) // BLOCK
    others = model.without_effect(step.name)
    thirds = [replace(prepared.measurement, fit=prepared.usable & (block % 3 == third)) for third in range(3)]
    fits, failed = [], []
    for third in thirds:
        try:
            fits.append(others.fitted(step.name, third))
        except (UsageError, ArithmeticError, np.linalg.LinAlgError) as error:
            failed.append(
                f"how well {step.name} is known is told by fits to a third of the recording each, and one failed:"
                f" {error}"
            )
    found = {}
    for parameter in effect.told:
        value = np.asarray(step.values[parameter.name], float)
        if value.size > 8:
            continue
        if len(fits) < 2:
            spread = np.full_like(value, parameter.low), np.full_like(value, parameter.high)
        else:
            spread = _spread(value, [np.asarray(fit[parameter.name], float) for fit in fits])
        found[parameter.name] = _interval(value, *spread, parameter.unit)
    return found, failed


def _spread(value: np.ndarray, fits: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high from the scatter of the fits and from how far their mean is off.

    What a third teaches otherwise than the half is known no better.
    """
    alike = [fit for fit in fits if fit.shape == value.shape]
    spread = (
        np.hypot(THIRDS_T * np.std(alike, axis=0, ddof=1), np.mean(alike, axis=0) - value)
        if len(alike) > 1
        else np.zeros_like(value)
    )
    return value - spread, value + spread


def _interval(value: np.ndarray, low: np.ndarray, high: np.ndarray, unit: str) -> Interval:
    if value.ndim == 0:
        return Interval(float(value), float(low), float(high), unit)
    middle, least, most = (tuple(map(float, part)) for part in (value, low, high))
    return Interval(middle, least, most, unit)
