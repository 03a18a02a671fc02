"""From the search's steps and what is left over to the verdict, its findings and its words."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from edgefilter.diagnosis.band_edge import cut_by_power
from edgefilter.diagnosis.compare import describe
from edgefilter.diagnosis.evidence import left_in_words, sentence
from edgefilter.diagnosis.noise_change import look_at_fan
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.result import Diagnosis, Finding, Interval
from edgefilter.diagnosis.score import Judge
from edgefilter.diagnosis.trials import Found, Trial, floor_level
from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel
from edgefilter.echo.recording import BLOCK

EXPLAINED_DB = 0.8
"""Excess up to which nothing is missing: what the fan of another day and a faint distortion leave."""
EXPLAINED = 0.45
"""Less of the excess level than this explained by all findings together is not what happened."""
STILL_THERE = 0.6
"""Of the excess in dB, more than this left is not explained either."""
PART, PART_LEVEL = 0.5, 0.3
"""Share of the excess power and of its level that findings must explain to be named beside what none explains."""
MUCH_DB = 3.0
"""Over the silences: what the model of an effect that is really there does not leave."""
NEARLY_ALL = 0.99
"""Share of the excess power with which what is left may be the imprecision of the model itself."""
THIRDS_T = 1.69
"""90 % quantile of Student's t with 2 degrees of freedom over the square root of 3: the interval from three fits to a third each."""


def conclude(prepared: Prepared, found: Found, progress: Callable[[str], None] | None = None) -> Diagnosis:
    """The diagnosis that a search leads to; the fan is looked at behind what the search has taken out of the voice."""
    comparison = describe(prepared, found.base.prediction)
    found, left = look_at_fan(found)
    remaining = found.final.excess_db
    unpredictable = any(find(step.name).leaves_noise for step in found.steps)
    believed = bool(found.steps) and (remaining < EXPLAINED_DB or _enough(prepared, found))
    quiet = found.base.excess_db < EXPLAINED_DB and not prepared.human
    verdict = "missing" if believed and not _much_left(found) else "explained" if quiet else "unexplained"
    if not believed and (quiet or not _partly(prepared, found)):
        sure = None if quiet else cut_by_power(found)
        found = sure or replace(found, steps=(), final=found.base, model=found.start)
        remaining = found.final.excess_db
    return Diagnosis(
        verdict=verdict,
        comparison=comparison,
        ranking=tuple(_findings(found, progress)),
        evidence=left_in_words(prepared, found, left, remaining, EXPLAINED_DB),
        remaining_db=remaining,
        irreducible_db=max(remaining, found.final.irreducible_db, 0.0) if unpredictable and verdict == "missing" else 0.0,
        model=found.model,
    )


def _enough(prepared: Prepared, found: Found) -> bool:
    """Whether the findings explain so much that they are what happened."""
    explained = explained_level(prepared, found)
    return explained >= EXPLAINED and found.final.excess_db < STILL_THERE * found.base.excess_db


def _partly(prepared: Prepared, found: Found) -> bool:
    """Whether the findings explain enough to be named beside something that none explains."""
    return _share(found.base.excess_db, found.final.excess_db) >= PART and explained_level(prepared, found) >= PART_LEVEL


def _much_left(found: Found) -> bool:
    """Whether the findings leave so much, also of the samples that they were fitted to, that something else is there besides.

    What they leave of the others alone is how well a recording of that length teaches them.
    """
    silent = float(np.clip(found.final.silent_db, -0.5, 0.5))
    return min(found.final.fitted_db, found.final.active_db) - silent > MUCH_DB and _share(found.base.excess_db, found.final.excess_db) < NEARLY_ALL


def explained_level(prepared: Prepared, found: Found) -> float:
    """Part of the level over the robot's silences that is gone, 0 to 1: of many cells rather than of the loudest."""
    judge = Judge(prepared)
    above = found.base.level_db - floor_level(judge, found.base)
    gone = above - (found.final.level_db - floor_level(judge, found.final))
    if any(find(name).stage == "noise" for name, _ in found.model.effects):
        above, gone = found.base.level_db, found.base.level_db - found.final.level_db
    return float(np.clip(gone / above, 0.0, 1.0)) if above > 0.0 else 0.0


def _share(before_db: float, after_db: float) -> float:
    """Part of the power over the fan that is gone."""
    before, after = 10 ** (before_db / 10) - 1.0, 10 ** (after_db / 10) - 1.0
    return float(np.clip(1.0 - after / before, 0.0, 1.0)) if before > 0.0 else 0.0


def _findings(found: Found, progress: Callable[[str], None] | None) -> list[Finding]:
    """Strongest first; each with the excess before and after it in the order in which they were added."""
    findings, before = [], found.base.excess_db
    for step in found.steps:
        after = found.final.excess_db if step is found.steps[-1] else step.verdict.excess_db
        if progress:
            progress(f"how well {step.name} is known")
        intervals = _intervals(found.prepared, found.model, step)
        findings.append(
            Finding(
                effect=step.name,
                excess_before_db=before,
                excess_after_db=after,
                share=max(_share(found.base.excess_db, after) - _share(found.base.excess_db, before), 0.0),
                parameters=intervals,
                evidence=sentence(step),
                values=step.values,
                prediction=step.verdict.prediction,
            )
        )
        before = after
    return sorted(findings, key=lambda finding: -finding.share)


def _intervals(prepared: Prepared, model: EchoModel, step: Trial) -> Mapping[str, Interval]:
    """Each scalar parameter, or short list, with the interval that three fits to a third of the recording each give."""
    effect = find(step.name)
    block = np.arange(prepared.usable.size) // BLOCK
    others = model.without_effect(step.name)
    thirds = [replace(prepared.measurement, fit=prepared.usable & (block % 3 == third)) for third in range(3)]
    fits = [complete(effect, effect.fit(third, others)) for third in thirds]
    found = {}
    for parameter in effect.parameters:
        value = np.asarray(step.values[parameter.name], float)
        if value.size > 8:
            continue
        found[parameter.name] = _interval(value, [np.asarray(fit[parameter.name], float) for fit in fits], parameter.unit)
    return found


def _interval(value: np.ndarray, fits: list[np.ndarray], unit: str) -> Interval:
    """From the scatter of the fits, and from how far their mean is off: what a third teaches otherwise than the half is known no better."""
    alike = [fit for fit in fits if fit.shape == value.shape]
    spread = np.hypot(THIRDS_T * np.std(alike, axis=0, ddof=1), np.mean(alike, axis=0) - value) if len(alike) > 1 else np.zeros_like(value)
    low, high = value - spread, value + spread
    if value.ndim == 0:
        return Interval(float(value), float(low), float(high), unit)
    return Interval(*(tuple(map(float, part)) for part in (value, low, high)), unit)


