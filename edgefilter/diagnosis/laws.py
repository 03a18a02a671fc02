"""Where names leave much of a recording: the free law of a family, beside them or in place of those of its family."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import reduce

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.select import without_superfluous
from edgefilter.diagnosis.trials import AHEAD, Found, Reading, Trial, Workbench, added
from edgefilter.echo.effects.catalogue import EFFECTS, find
from edgefilter.echo.effects.free_laws import FreeLaw
from edgefilter.echo.measurement import Values

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
        given = {parameter.name for parameter in find(self.effect).parameters if parameter.given}
        known = ((key, value) for key, value in self.values.items() if key not in given)
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
    """Add a free law, a fitted curve or response instead of an effect with a name, where the effects that a search has found leave much unexplained.

    A law in addition to these effects has to explain more than chance would. One that replaces the effects of its own family, which
    is known to act, has to predict held-out samples better than they do, and is preferred only where it explains much more.
    Effects that the law makes superfluous are dropped. No law is tried where the effects leave as little as right ones do.
    """
    bench = Workbench(found.recording, criteria, progress, without, found.start)
    left = max(found.final.over_db - found.final.floor_db, 0.0)
    if found.final.excess_db <= (criteria.little_db if found.steps else criteria.explained_db):
        return found
    names = {step.name for step in found.steps}
    tried = [law for law in _trials(bench, found, without) if law.gain_db >= criteria.part * left]
    instead = [law for law in tried if not names <= dict(law.model.effects).keys()]
    beside = [law for law in tried if law not in instead and bench.admissible(law)]
    most = criteria.nearly * max((law.gain_db for law in (*instead, *beside)), default=0.0)
    choices = [law for law in beside if law.gain_db >= most] or [*instead, *beside]
    if not choices:
        return found
    law = max(choices, key=lambda law: law.gain_db)
    model = without_superfluous(bench, found.start, law.model, law.name)
    return _with(found, Trial.of(law.name, model, found.final, bench.score(model)))


def _trials(bench: Workbench, found: Found, without: Collection[str]) -> Iterator[Trial]:
    """Each law beside all names, and in place of those of its family; how much more it explains than all names."""
    for effect in EFFECTS:
        if not effect.free or effect.name in {AHEAD, *without}:
            continue
        family = [
            step.name for step in found.steps if not find(step.name).free and find(step.name).family == effect.family
        ]
        others = reduce(bench.less, family, found.model)
        for kept in dict.fromkeys((found.model, others)):
            if tried := bench.attempt(effect.name, kept):
                yield Trial.of(effect.name, tried.model, found.final, tried.score)


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


def _written(value: object) -> str:
    """Source text in Python of a number or an array."""
    digits = np.round(np.asarray(value, float), 5).tolist()
    return f"np.array({digits})" if isinstance(digits, list) else repr(digits)
