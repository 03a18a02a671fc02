"""Where names leave much of a recording: the free law of a family, beside them or in place of those of its family."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from edgefilter.diagnosis.closer_look import Curve
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.score import Scorer
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import EFFECTS, find
from edgefilter.echo.effects.free_laws import FreeLaw
from edgefilter.echo.evidence import Score
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel
from edgefilter.errors import UsageError

MOST = 2
"""Laws at once: a bound on the work."""
FILE = '''"""{title}, as `edgefilter diagnose` found it: {words}."""

import numpy as np

from edgefilter.echo.effects.free_laws import {base}

FOUND = {{
{values}}}


class {class_name}({base}):
    """What {base} makes of its values is in edgefilter/echo/effects/free_laws.py: change FOUND, or write `apply` and `run` here."""

    name = "{name}"

    def fit(self, measurement, model):
        return FOUND
'''


@dataclass(frozen=True, eq=False)
class Law:
    """A free law that a diagnosis gives: the effect that holds it, what it is, in words and drawn.

    beside: names of the listed effects that it stands beside. gain_db: by which it lowers the held-out level;
    excess_db: what is left then, as of any comparison.
    """

    effect: str
    family: str
    words: str
    curve: Curve
    beside: tuple[str, ...]
    gain_db: float
    excess_db: float
    values: Values = field(repr=False)

    def file(self, name: str) -> str:
        """The text of a Python file that defines an effect of that name."""
        known = ((key, value) for key, value in self.values.items() if not _given(self.effect, key))
        return FILE.format(
            title=f"{self.family[:1].upper()}{self.family[1:]}",
            words=self.words,
            base=type(find(self.effect)).__name__,
            values="".join(f'    "{key}": {_written(value)},\n' for key, value in known),
            class_name=name.title().replace("_", ""),
            name=name,
        )

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {
            "effect": self.effect,
            "family": self.family,
            "words": self.words,
            "beside": list(self.beside),
            "gain_db": round(self.gain_db, 3),
            "excess_db": round(self.excess_db, 3),
            "curve": self.curve.to_dict(),
        }


def law_of(found: Found) -> Law | None:
    """The law among what was found that explains most."""
    laws = [step for step in found.steps if find(step.name).free]
    if not laws:
        return None
    step = max(laws, key=lambda step: step.gain_db)
    effect, others = find(step.name), tuple(one.name for one in found.steps if one is not step)
    curve = Curve.of(*_drawn(effect, step.values))
    excess_db = found.final.excess_db
    return Law(
        step.name, effect.family, effect.sentence(step.values), curve, others, step.gain_db, excess_db, step.values
    )


def with_laws(
    found: Found,
    criteria: Criteria,
    progress: Callable[[str], None] | None = None,
    without: Collection[str] = (),
) -> Found:
    """What a search has found, with the laws without which it leaves much of the recording.

    A law beside all names has to be there by more than chance; one in place of the names of its family, which is known
    to be there, has to predict more than they do. It is preferred only where it explains much more. What the law makes
    superfluous is dropped. None is looked for where the names leave as little as those of right ones do.
    """
    scorer = Scorer(found.prepared)
    for _ in range(MOST):
        left = max(found.final.over_db - found.final.floor_db, 0.0)
        if found.final.excess_db <= (criteria.little_db if found.steps else criteria.explained_db):
            break
        names = tuple(step.name for step in found.steps)
        tried = [law for law in _trials(scorer, found, progress, without) if law.gain_db >= criteria.part * left]
        shown = [law for law in tried if law.kept != names or p_value(law.name, law.gain_db) <= criteria.false_rate]
        most = max((law.gain_db for law in shown), default=0.0)
        beside = [law for law in shown if law.kept == names and law.gain_db >= criteria.nearly * most]
        best = max(beside or shown, key=lambda law: law.gain_db, default=None)
        if best is None:
            break
        found = _rebuilt(scorer, found, _without_superfluous(scorer, found, best, criteria))
    return found


@dataclass(frozen=True, eq=False)
class _Tried:
    """A law beside the names that are kept: the model, its score, and by how many dB the level is lower than by all names."""

    name: str
    kept: tuple[str, ...]
    model: EchoModel
    score: Score
    gain_db: float


def _trials(
    scorer: Scorer, found: Found, progress: Callable[[str], None] | None, without: Collection[str]
) -> Iterator[_Tried]:
    """Each law beside all names, and in place of those of its family."""
    names = tuple(step.name for step in found.steps)
    for effect in EFFECTS:
        if not effect.free or effect.name in {*without, *dict(found.model.effects)}:
            continue
        if progress:
            progress(f"trying {effect.title}")
        others = tuple(name for name in names if find(name).free or find(name).family != effect.family)
        for kept in dict.fromkeys((names, others)):
            if tried := _tried(scorer, found, effect.name, kept):
                yield tried


def _tried(scorer: Scorer, found: Found, name: str, kept: tuple[str, ...]) -> _Tried | None:
    """A law fitted beside some of the names; None where its fit finds nothing."""
    others, known = found.start, dict(found.model.effects)
    for other in kept:
        others = others.with_effect(other, known[other])
    try:
        values = others.fitted(name, scorer.behind(others).measurement)
    except (UsageError, ArithmeticError, np.linalg.LinAlgError):
        return None
    if vanishes(find(name), values):
        return None
    model = others.with_effect(name, values)
    score = scorer.of(model)
    return _Tried(name, kept, model, score, found.final.level_db - score.level_db)


def _without_superfluous(scorer: Scorer, found: Found, law: _Tried, criteria: Criteria) -> _Tried:
    """The law without the names beside which it explains no more than by chance."""
    for name in law.kept:
        alone = _tried(scorer, found, law.name, tuple(other for other in law.kept if other != name))
        if alone and p_value(name, law.gain_db - alone.gain_db) > criteria.false_rate:
            law = alone
    return law


def _rebuilt(scorer: Scorer, found: Found, law: _Tried) -> Found:
    """The outcome with a law, each effect with what it explains beside those before it; like: the strongest name that the law replaces."""
    model, before, steps, known = found.start, found.base, [], dict(law.model.effects)
    for name in (*law.kept, law.name):
        model = model.with_effect(name, known[name])
        score = law.score if name == law.name else scorer.of(model)
        steps.append(Trial.of(name, model, before, score))
        before = score
    family = find(law.name).family
    replaced = [step for step in found.steps if step.name not in law.kept and find(step.name).family == family]
    like = {law.name: replaced[0].name} if replaced else {}
    return replace(found, model=law.model, final=law.score, steps=tuple(steps), like={**found.like, **like})


def _drawn(effect: object, values: Values) -> tuple:
    """The arguments of Curve.of for a law."""
    assert isinstance(effect, FreeLaw)
    name, unit, x, y, y_unit = effect.drawn(values)
    return name, unit, x, y, 1.0, y_unit


def _given(effect: str, key: str) -> bool:
    return any(p.given for p in find(effect).parameters if p.name == key)


def _written(value: object) -> str:
    """Source text in Python of a number or an array."""
    digits = np.round(np.asarray(value, float), 5).tolist()
    return f"np.array({digits})" if isinstance(digits, list) else repr(digits)
