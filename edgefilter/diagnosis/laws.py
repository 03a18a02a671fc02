"""Where names leave much of a recording: the free law of a family, beside them or in place of those of its family."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.trials import AHEAD, Found, Reading, Trial, added
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import EFFECTS, find
from edgefilter.echo.effects.free_laws import FreeLaw
from edgefilter.echo.measurement import Values
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


@dataclass(frozen=True)
class Curve:
    """A law drawn: x and y (k,), a gain unless y_unit says otherwise; share: part of what is left without it that it explains."""

    name: str
    x_unit: str
    x: tuple[float, ...]
    y_db: tuple[float, ...]
    share: float
    y_unit: str = "dB"

    @classmethod
    def of(cls, law: Trial) -> Curve:
        """That of a free law that was fitted; share: of the level over the silences."""
        effect = find(law.name)
        assert isinstance(effect, FreeLaw)
        name, unit, x, y, y_unit = effect.drawn(law.values)
        left = law.gain_db + law.score.over_db - law.score.floor_db
        share = float(np.clip(law.gain_db / max(left, 1e-9), 0.0, 1.0))
        return cls(name, unit, tuple(map(float, x)), tuple(map(float, y)), share, y_unit)

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        rounded = {"x": np.round(self.x, 3).tolist(), "y_db": np.round(self.y_db, 2).tolist()}
        return {**asdict(self), **rounded, "share": round(self.share, 4)}


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
        """The text of a Python file that defines this law as an effect called `name`."""
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
    words, curve, excess_db = effect.sentence(step.values), Curve.of(step), found.final.excess_db
    return Law(step.name, effect.family, words, curve, others, step.gain_db, excess_db, step.values)


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
    for _ in range(MOST):
        left = max(found.final.over_db - found.final.floor_db, 0.0)
        if found.final.excess_db <= (criteria.little_db if found.steps else criteria.explained_db):
            break
        names = {step.name for step in found.steps}
        if not (tried := list(_trials(found, progress, without))):
            break
        tried = [law for law in tried if law.gain_db >= criteria.part * left]
        instead = [law for law in tried if not names <= dict(law.model.effects).keys()]
        beside = [law for law in tried if law not in instead and law.p_value <= criteria.false_rate]
        most = criteria.nearly * max((law.gain_db for law in (*instead, *beside)), default=0.0)
        choices = [law for law in beside if law.gain_db >= most] or [*instead, *beside]
        if not choices:
            break
        best = max(choices, key=lambda law: law.gain_db)
        found = _with(found, _without_superfluous(found, best, criteria))
    return found


def _trials(found: Found, progress: Callable[[str], None] | None, without: Collection[str]) -> Iterator[Trial]:
    """Each law beside all names, and in place of those of its family; how much more it explains than all names."""
    names = tuple(step.name for step in found.steps)
    for effect in EFFECTS:
        if not effect.free or effect.name in {AHEAD, *without, *dict(found.model.effects)}:
            continue
        if progress:
            progress(f"trying {effect.title}")
        others = tuple(name for name in names if find(name).free or find(name).family != effect.family)
        for kept in dict.fromkeys((names, others)):
            if tried := _tried(found, effect.name, kept):
                yield tried


def _tried(found: Found, name: str, kept: Iterable[str]) -> Trial | None:
    """A law fitted beside some of the names; None where its fit finds nothing."""
    others, known = found.start, dict(found.model.effects)
    for other in kept:
        others = others.with_effect(other, known[other])
    try:
        values = found.recording.fitted(name, others)
    except (UsageError, ArithmeticError, np.linalg.LinAlgError):
        return None
    if vanishes(find(name), values):
        return None
    model = others.with_effect(name, values)
    return Trial.of(name, model, found.final, found.recording.of(model))


def _without_superfluous(found: Found, law: Trial, criteria: Criteria) -> Trial:
    """The law without the names beside which it explains no more than by chance."""
    for name in added(found.start, law.model)[:-1]:
        *kept, _ = added(found.start, law.model)
        alone = _tried(found, law.name, [other for other in kept if other != name])
        if alone and p_value(name, law.gain_db - alone.gain_db) > criteria.false_rate:
            law = alone
    return law


def _with(found: Found, law: Trial) -> Found:
    """The outcome with a law, under the strongest name that it replaces."""
    family, values = find(law.name).family, dict(law.model.effects)
    replaced = [step for step in found.steps if step.name not in values and find(step.name).family == family]
    outcome = found.with_only({name: values[name] for name in added(found.start, law.model)})
    if not replaced:
        return outcome
    known_db, first = sum(step.gain_db for step in replaced), replaced[0].name
    reading = found.like.get(first, Reading(first, known_db / (known_db + law.gain_db)))
    return replace(outcome, like={**found.like, law.name: reading})


def _given(effect: str, key: str) -> bool:
    return any(p.given for p in find(effect).parameters if p.name == key)


def _written(value: object) -> str:
    """Source text in Python of a number or an array."""
    digits = np.round(np.asarray(value, float), 5).tolist()
    return f"np.array({digits})" if isinstance(digits, list) else repr(digits)
