"""What a search says in the end: the verdict, the effects with their evidence, and what nothing explains."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from edgefilter.diagnosis.candidates import asks, candidates
from edgefilter.diagnosis.compare import Comparison, describe, independence_of
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.laws import law_of, with_laws
from edgefilter.diagnosis.leftover import left_in_words, leftover
from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.precision import precision
from edgefilter.diagnosis.result import Diagnosis, Finding, Interval, Verdict, in_order
from edgefilter.diagnosis.straightened import Straightened, share_of
from edgefilter.diagnosis.trials import Found, less, steps_of
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel

HELD = "; the profile holds this effect with other values"
"""Behind the evidence of an effect that has changed."""


def as_written(found: Diagnosis, prepared: Straightened, values: Mapping[str, Values], after: Comparison) -> Diagnosis:
    """The diagnosis with the values of a profile that holds all its findings, and what each leaves then."""
    before = replace(describe(prepared, prepared.model), warnings=found.comparison.warnings)
    steps = steps_of(prepared.of, prepared.model, {one.effect: values[one.effect] for one in in_order(found.ranking)})
    excess_db = [before.excess_db, *(step.score.excess_db for step in steps[:-1]), after.excess_db]
    findings: dict[str, Finding] = {}
    for finding, (was_db, left_db) in zip(in_order(found.ranking), pairwise(excess_db), strict=False):
        name = finding.effect
        share = max(share_of(before.excess_db, left_db) - share_of(before.excess_db, was_db), 0.0)
        findings[name] = replace(
            finding,
            excess_before_db=was_db,
            excess_after_db=left_db,
            share=share,
            parameters={key: interval.at(values[name][key]) for key, interval in finding.parameters.items()},
            evidence=evidence_of(name, values[name], prepared.model, finding.evidence),
            values=values[name],
        )
    return replace(
        found,
        comparison=before,
        ranking=tuple(findings[finding.effect] for finding in found.ranking),
        remaining_db=after.excess_db,
        model=steps[-1].model if steps else prepared.model,
        precision=found.precision.at(values),
        written=after,
    )


def conclude(
    prepared: Straightened,
    found: Found,
    criteria: Criteria,
    progress: Callable[[str], None] | None = None,
    without: Collection[str] = (),
) -> Diagnosis:
    """The diagnosis that a search leads to; without: names of free laws that are not tried either."""
    comparison = describe(prepared, found.start, found.base)
    searched, found = found, with_laws(found, criteria, progress, without)
    left = leftover(found)
    believed = bool(found.steps) and _believed(found, criteria)
    quiet = found.base.excess_db < criteria.explained_db and not prepared.human
    verdict: Verdict = "missing" if found.steps and holds(found, criteria) else "explained" if quiet else "unexplained"
    # enough to be named beside something that none explains
    part = share_of(found.base.excess_db, found.final.excess_db)
    partly = part >= criteria.half and explained_level(found) >= criteria.part
    if not believed and (quiet or not partly):
        shown = {step.name: step.values for step in found.steps if find(step.name).shows_in_silence}
        found = found.with_only(shown)  # silences and voice both show it
    unpredictable = any(find(step.name).adds_noise for step in found.steps)
    remaining = found.final.excess_db
    known, intervals, doubts = precision(found, progress)
    findings = findings_of(found, intervals)
    tried = candidates(searched, [finding.effect for finding in findings])
    return Diagnosis(
        verdict=verdict,
        comparison=replace(comparison, warnings=(*comparison.warnings, *found.notes, *doubts)),
        ranking=findings,
        evidence=left_in_words(found, left, remaining, criteria.explained_db),
        remaining_db=remaining,
        irreducible_db=(
            max(remaining, found.final.irreducible_db, 0.0) if unpredictable and verdict == "missing" else 0.0
        ),
        model=found.model,
        tried=tried,
        independence=independence_of(found.recording, found.model, found.final)
        if findings
        else comparison.independence,
        precision=known,
        advice=asks(tried),
        law=law_of(found),
    )


def findings_of(found: Found, intervals: Mapping[str, Mapping[str, Interval]]) -> tuple[Finding, ...]:
    """The findings, the effect without which most is left first; intervals: of their parameters, by effect.

    Each has the excess over the fan before and after its effect was added. A change of the fan's noise comes first only where it
    explains more than all other findings together.
    """
    findings, before = [], found.base.excess_db
    for step in found.steps:
        without_db = found.recording.of(less(found.start, found.model, step.name)).level_db
        after = found.final.excess_db if step is found.steps[-1] else step.score.excess_db
        otherwise = f"with {step.name} the held-out residual falls by {step.gain_db:.2f} dB"
        findings.append(
            Finding(
                effect=step.name,
                family=find(step.name).family,
                p_value=min(step.p_value, p_value(step.name, without_db - found.final.level_db)),
                excess_before_db=before,
                excess_after_db=after,
                share=max(share_of(found.base.excess_db, after) - share_of(found.base.excess_db, before), 0.0),
                parameters=intervals.get(step.name, {}),
                evidence=evidence_of(step.name, step.values, found.start, otherwise),
                values=step.values,
                prediction=step.score.prediction,
                like=found.like.get(step.name),
            )
        )
        before = after
    voice, noise = ([f for f in findings if (find(f.effect).stage == "noise") is fan] for fan in (False, True))
    first = noise and sum(f.share for f in noise) > sum(f.share for f in voice)
    return tuple((*noise, *voice) if first else (*voice, *noise))


def evidence_of(name: str, values: Values, start: EchoModel, otherwise: str) -> str:
    """What an effect says of its values, or otherwise; and that the start has it already, where it has."""
    held = name in dict(start.effects)
    if held and vanishes(find(name), values):
        return "the recording shows nothing of it, and the profile holds it"
    said = find(name).sentence(values) or otherwise.removesuffix(HELD)
    return said + (HELD if held else "")


def holds(found: Found, criteria: Criteria) -> bool:
    """Whether the effects that a model has beyond its start are what happened, and all that did."""
    return _believed(found, criteria) and not _much_left(found, criteria)


def _believed(found: Found, criteria: Criteria) -> bool:
    """Whether the findings leave next to nothing, or explain so much that they are what happened."""
    much = found.final.excess_db < criteria.half * found.base.excess_db
    return found.final.excess_db < criteria.explained_db or (much and explained_level(found) >= criteria.half)


def _much_left(found: Found, criteria: Criteria) -> bool:
    """Whether the findings leave so much that something else is there besides."""
    silent = float(np.clip(found.final.silent_db, -0.5, 0.5))
    return (
        found.final.active_db - silent > criteria.much_db
        and share_of(found.base.excess_db, found.final.excess_db) < criteria.nearly_all
    )


def explained_level(found: Found) -> float:
    """Part of the level over the robot's silences that is gone, 0 to 1: of many cells rather than of the loudest."""
    above = found.base.over_db - found.final.floor_db
    gone = found.base.over_db - found.final.over_db
    return float(np.clip(gone / above, 0.0, 1.0)) if above > 0.0 else 0.0
