"""What a search leaves unexplained: whether it is noise that follows the voice, as a codec's does."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.score import Judge
from edgefilter.diagnosis.trials import Found, beside
from edgefilter.echo.effects.catalogue import find, names


def noise_of_the_voice(
    found: Found, cut: Found | None, criteria: Criteria, without: Collection[str] = ()
) -> Found | None:
    """A search's outcome with the effect that is told by what the others leave, where the rest looks so and it leaves little of that.

    Beside cut, the cut of the band that the recording's power shows; else beside what was found, where that explains a good
    part of the level beside it; else alone. None where there is no such thing.
    """
    judge, start = Judge(found.prepared), replace(found, model=found.start, final=found.base, steps=())
    of_the_fan = any(find(step.name).is_of_the_fan for step in found.steps)
    others = cut, found if found.steps else None, None if of_the_fan else start
    for name in (name for name in names() if find(name).in_what_is_left and name not in without):
        with_cut, with_found, alone = (known and _with(judge, name, known, criteria) for known in others)
        if with_found and alone and _share(alone, with_found) < criteria.part:
            with_found = None
        end = with_cut or with_found or alone
        if end and end.final.excess_db < max(criteria.explained_db, criteria.half * found.base.excess_db):
            return end
    return None


def _with(judge: Judge, name: str, others: Found, criteria: Criteria) -> Found | None:
    """An outcome with the effect as its last step; None where that is not to be named."""
    step = beside(judge, name, others.model, criteria, others.final)
    return replace(others, model=step.model, final=step.score, steps=(*others.steps, step)) if step else None


def _share(alone: Found, both: Found) -> float:
    """Of the level that all of it explains, the part that the others do beside the last."""
    explained = alone.base.level_db - both.final.level_db
    return (alone.final.level_db - both.final.level_db) / max(explained, 1e-9)
