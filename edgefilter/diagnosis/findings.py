"""What a search has found, of each effect by itself: its part of the excess, its parameters and how well they are known."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.result import Finding, Interval
from edgefilter.diagnosis.straightened import Straightened, share_of
from edgefilter.diagnosis.trials import Found, Trial, less
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel
from edgefilter.echo.recording import BLOCK
from edgefilter.errors import UsageError

HELD = "; the profile holds this effect with other values"
"""Behind the evidence of an effect that has changed."""
THIRDS_T = 1.69
"""90 % quantile of Student's t with 2 degrees of freedom over the square root of 3: the interval from three fits to a
third each."""


def findings_of(found: Found, progress: Callable[[str], None] | None) -> tuple[tuple[Finding, ...], list[str]]:
    """The findings, the one that is missed most first, and what is not known of them.

    Each has the excess before and after it in the order of the steps. A change of the fan comes first only where it is
    more than all the rest.
    """
    findings, doubts, before = [], [], found.base.excess_db
    for step in found.steps:
        without_db = found.recording.of(less(found.start, found.model, step.name)).level_db
        after = found.final.excess_db if step is found.steps[-1] else step.score.excess_db
        if progress:
            progress(f"how well {step.name} is known")
        intervals, doubt = _intervals(found.recording, found.model, step)
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
                evidence=evidence_of(
                    step.name,
                    step.values,
                    found.start,
                    f"with {step.name} the held-out residual falls by {step.gain_db:.2f} dB",
                ),
                values=step.values,
                prediction=step.score.prediction,
                like=found.like.get(step.name),
            )
        )
        before = after
    voice, noise = ([f for f in findings if (find(f.effect).stage == "noise") is fan] for fan in (False, True))
    first = noise and sum(f.share for f in noise) > sum(f.share for f in voice)
    return tuple((*noise, *voice) if first else (*voice, *noise)), doubts


def evidence_of(name: str, values: Values, start: EchoModel, otherwise: str) -> str:
    """What an effect says of its values, or otherwise; and that the start has it already, where it has."""
    held = name in dict(start.effects)
    if held and vanishes(find(name), values):
        return "the recording shows nothing of it, and the profile holds it"
    said = find(name).sentence(values) or otherwise.removesuffix(HELD)
    return said + (HELD if held else "")


def _intervals(recording: Straightened, model: EchoModel, step: Trial) -> tuple[Mapping[str, Interval], list[str]]:
    """Each scalar parameter, or short list, with the interval from fits to a third of the recording each; which failed.

    Where fewer than two thirds can be fitted, a parameter may have any of its possible values.
    """
    if not find(step.name).told:
        return {}, []
    block = np.arange(recording.usable.size) // BLOCK
    others = model.without_effect(step.name)
    fits, failed = [], []
    for third in range(3):
        try:
            part = recording.fitted_to(recording.usable & (block % 3 == third))
            fits.append(part.fitted(step.name, others))
        except (UsageError, ArithmeticError, np.linalg.LinAlgError) as error:
            failed.append(
                f"how well {step.name} is known is told by fits to a third of the recording each, and one failed:"
                f" {error}"
            )
    found = {}
    for parameter in find(step.name).told:
        value = np.asarray(step.values[parameter.name], float)
        if value.size > 8:
            continue
        if len(fits) < 2:
            low, high = np.full_like(value, parameter.low), np.full_like(value, parameter.high)
        else:
            spread = _spread(value, [np.asarray(fit[parameter.name], float) for fit in fits])
            low, high = np.clip(spread, parameter.low, parameter.high)
        found[parameter.name] = Interval.of(value, low, high, parameter.unit)
    return found, failed


def _spread(value: np.ndarray, fits: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high from the scatter of the fits and from how far their mean is off: it is known no better than that."""
    alike = [fit for fit in fits if fit.shape == value.shape]
    spread = np.zeros_like(value)
    if len(alike) > 1:
        spread = np.hypot(THIRDS_T * np.std(alike, axis=0, ddof=1), np.mean(alike, axis=0) - value)
    return value - spread, value + spread
