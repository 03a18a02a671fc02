"""What a search leaves unexplained: whether it is noise that follows the voice, as a codec's does."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from edgefilter.diagnosis.band_edge import cut_by_power
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.score import Judge
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effect import fitted, vanishes
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.evidence import Evidence


def noise_of_the_voice(found: Found, criteria: Criteria, without: Collection[str] = ()) -> Found | None:
    """A search's outcome with the effect that is told by what the others leave, where the rest looks so and it leaves little of that.

    Beside a cut of the band that the recording's power shows; else beside what was found, where that explains a good part of
    the level beside it; else alone. None where there is no such thing.
    """
    judge, start = Judge(found.prepared), replace(found, model=found.start, final=found.base, steps=())
    of_the_fan = any(find(step.name).stage == "noise" or find(step.name).shows_in_silence for step in found.steps)
    others = cut_by_power(found, criteria), found if found.steps else None, None if of_the_fan else start
    for name in (name for name in names() if find(name).in_what_is_left and name not in without):
        cut, beside, by_itself = (known and _with(judge, name, known) for known in others)
        if beside and by_itself and _share(by_itself, beside) < criteria.second_share:
            beside = None
        end = cut or beside or by_itself
        if end and end.final.excess_db < max(criteria.explained_db, criteria.noise_left * found.base.excess_db):
            return end
    return None


def _with(judge: Judge, name: str, others: Found) -> Found | None:
    """An outcome with the effect beside it; None where it is there, or what is left does not look like it."""
    effect, before = find(name), others.final
    if name in dict(others.model.effects):
        return None
    values = fitted(effect, judge.measurement, others.model)
    if vanishes(effect, values):
        return None
    model = others.model.with_effect(name, values)
    after = judge.of(model)
    if not effect.plausible(Evidence(values, others.model, judge, before, after)):
        return None
    step = Trial(name, values, model, after, before.level_db - after.level_db, judge.noise_size_db(model))
    return replace(others, model=model, final=after, steps=(*others.steps, step))


def _share(alone: Found, beside: Found) -> float:
    """Of the level that all of it explains, the part that the others do beside it."""
    explained = alone.base.level_db - beside.final.level_db
    return (alone.final.level_db - beside.final.level_db) / max(explained, 1e-9)
