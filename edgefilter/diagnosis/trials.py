"""One effect tried on a model of a recording: what it explains on held-out samples, and whether that is enough to name it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import p_value, percent
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.score import Scorer
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.evidence import Evidence, Score
from edgefilter.echo.measurement import STEADY_DB, Values
from edgefilter.echo.model import EchoModel
from edgefilter.errors import UsageError

Signature: TypeAlias = tuple[tuple[str | bytes, ...], ...]


@dataclass(frozen=True, eq=False)
class Trial:
    """One effect added to a model: its values, the model with it, its score, and by how many dB the held-out level falls."""

    name: str
    values: Values
    model: EchoModel
    score: Score
    gain_db: float

    @classmethod
    def of(cls, name: str, model: EchoModel, before: Score, after: Score) -> Trial:
        """The effect of that name in a model, from the scores without it and with it."""
        return cls(name, dict(model.effects)[name], model, after, before.level_db - after.level_db)

    @property
    def p_value(self) -> float:
        """By chance as much (diagnosis/ordinary.py)."""
        return p_value(self.name, self.gain_db)


@dataclass(frozen=True, eq=False)
class Tried:
    """What came of one effect in a search: beside the start alone, and beside what the search has found; None where it was not fitted.

    short: why it could not be named beside the start, empty where it could. failed: why its fit failed. spared: whether
    it was not even fitted, since what is left is too little for it to be named.
    """

    name: str
    alone: Trial | None
    beside: Trial | None
    short: str = ""
    failed: str = ""
    spared: bool = False


@dataclass(frozen=True, eq=False)
class Found:
    """The outcome of a search from a start model.

    steps: the accepted effects in their order. notes: what the reader must know of the search. tried: every effect that
    was fitted. like: of a free law the name of its family that it replaces.
    """

    prepared: Prepared
    start: EchoModel
    model: EchoModel
    base: Score
    final: Score
    steps: tuple[Trial, ...]
    notes: tuple[str, ...] = ()
    tried: tuple[Tried, ...] = ()
    like: Mapping[str, str] = field(default_factory=dict)

    def with_only(self, scorer: Scorer, values: Mapping[str, Values]) -> Found:
        """The outcome with nothing but these effects, each with what it explains beside those before it."""
        model, score, steps = self.start, self.base, []
        for name, of in values.items():
            model, before = model.with_effect(name, of), score
            score = scorer.of(model)
            steps.append(Trial.of(name, model, before, score))
        return replace(self, model=model, final=score, steps=tuple(steps))

    @cached_property
    def in_noise(self) -> Prepared:
        """The recording prepared with the fan that was found."""
        return self.prepared.behind(self.model)


class Workbench:
    """Tries effects on models of one prepared recording and remembers what came of it."""

    def __init__(
        self,
        prepared: Prepared,
        criteria: Criteria,
        progress: Callable[[str], None] | None = None,
        without: Collection[str] = (),
        start: EchoModel | None = None,
    ) -> None:
        self.prepared, self.criteria = prepared, criteria
        self._start = start or prepared.model
        # what the start has at neutral values is in its path (Effect.absorbed): no search claims it
        taken_up = (name for name, values in self._start.effects if vanishes(find(name), values))
        self._without = {*without, *taken_up}
        self.scorer = Scorer(prepared)
        self._progress = progress
        self._scores: dict[Signature, Score] = {}
        self._trials: dict[tuple[Signature, str], Trial | None] = {}
        self._alike: dict[tuple[frozenset[str], str], Trial | None] = {}
        self._cost = 0
        self._failed: dict[str, str] = {}
        self._spared: set[str] = set()
        self._in_vain: dict[str, float] = {}
        self._refused, self._so_far = False, ""

    @property
    def notes(self) -> tuple[str, ...]:
        """What could not be tried, and why."""
        spent = (
            f"the search was stopped after fits of {self._cost / 10:.0f} s: something further may be in the recording"
        )
        return (*self._failed.values(), *((spent,) if self._refused else ()))

    def so_far(self, model: EchoModel) -> None:
        """Tell with what is tried next what a model has beyond the start, and what it leaves."""
        if names := added(self._start, model):
            self._so_far = f"; so far {' and '.join(names)}: {self.score(model).excess_db:.1f} dB left"

    def score(self, model: EchoModel) -> Score:
        """The score of a model, worked out once."""
        key = signature(model)
        if key not in self._scores:
            self._scores[key] = self.scorer.of(model)
        return self._scores[key]

    def off_db(self, model: EchoModel) -> float:
        """How far what a model leaves is from the noise that it expects, dB.

        While the robot is heard, over its silences, of half a dB either way; or in these, less by what a fan differs
        from day to day.
        """
        score = self.score(model)
        told = score.active_db - float(np.clip(score.silent_db, -0.5, 0.5))
        return max(told, abs(self.scorer.silent_db(score)) - STEADY_DB)

    def explained(self, model: EchoModel) -> bool:
        """Whether a model leaves so little while the robot is heard that nothing further can be told in it."""
        return self.off_db(model) <= self.criteria.heard_db

    def little(self, model: EchoModel, start: EchoModel) -> bool:
        """Whether a model leaves so little of what start leaves that the right effects may be in it."""
        share = _over_fan(self.score(model).active_db) / max(_over_fan(self.score(start).active_db), 1e-12)
        return self.off_db(model) <= self.criteria.little_db and share <= self.criteria.nothing

    def left(self, model: EchoModel) -> float:
        """Level in dB over that of the silences."""
        score = self.score(model)
        return max(score.over_db - score.floor_db, 0.0)

    def attempt(self, name: str, model: EchoModel) -> Trial | None:
        """The effect of that name fitted beside what the model has.

        None where its fit finds nothing, where what the model leaves is too little for it to be named, or no further
        fit may be made.
        """
        if not self._in_reach(name, model):
            self._spared.add(name)
            return None
        key = signature(model), name
        if key not in self._trials:
            if self._cost >= self.criteria.most_cost:
                self._refused = True
                return None
            self._trials[key] = self._alike[frozenset(dict(model.effects)), name] = self._attempt(name, model)
            self._cost += find(name).cost
        return self._trials[key]

    def _in_reach(self, name: str, model: EchoModel) -> bool:
        """Whether an effect could be named beside a model if it explained all that this leaves, over the silences or over the fan."""
        most = max(self.left(model), abs(self.score(model).over_db))
        return p_value(name, most) <= self.criteria.false_rate

    def attempt_alike(self, name: str, model: EchoModel) -> Trial | None:
        """Return attempt(), or what came of it beside the same effects at other values: enough to choose what is worth a closer look."""
        key = frozenset(dict(model.effects)), name
        return self._alike[key] if key in self._alike else self.attempt(name, model)

    def _attempt(self, name: str, model: EchoModel) -> Trial | None:
        if self._progress:
            self._progress(f"trying {name}{self._so_far}")
        effect, others = find(name), model.without_effect(name)
        try:
            values = others.fitted(name, self.scorer.behind(others).measurement)
        except (UsageError, ArithmeticError, np.linalg.LinAlgError) as error:
            self._failed[name] = f"{name} could not be fitted and was left out: {error}"
            return None
        if vanishes(effect, values) and name not in dict(model.effects):
            return None
        return self.beside(name, model, model.with_effect(name, values))

    def beside(self, name: str, others: EchoModel, model: EchoModel) -> Trial:
        """What the effect of that name explains that model has and others has not."""
        before, after = self.score(others), self.score(model)
        return Trial.of(name, model, before, after)

    def halves(self, trial: Trial, model: EchoModel) -> bool:
        """Whether a trial takes away about half of the power over the fan, though the level hardly falls.

        A narrow ring does so, in few cells. Beside a long filter an effect may do so where that filter was fitted and
        so leaves no more
        than there is besides: of the held-out samples the filter itself leaves the most.
        """
        before, after, most = self.score(model), trial.score, self.criteria.half
        short = find(trial.name).complexity < self.criteria.long_filter
        where_fitted = short and _over_fan(after.fitted_db) < most * _over_fan(before.fitted_db)
        return where_fitted or _over_fan(after.active_db) < most * _over_fan(before.active_db)

    def attempt_all(self, model: EchoModel, most: int = 9) -> list[Trial]:
        """Each effect that the model has not and whose complexity is at most `most`.

        The last resorts only where none of the others explains a good part of what is left, and not where they were not to be
        named in less.
        """
        left, absent = self.left(model), self.absent(model, most)
        found = self._attempt_in_turn([name for name in absent if not find(name).last_resort], model)
        resorts = [name for name in absent if find(name).last_resort and left < self._in_vain.get(name, np.inf)]
        enough = self.criteria.part * left
        if not resorts or self.little(model, self.prepared.model):
            return found
        if any((t.gain_db > enough or self.halves(t, model)) and self.admissible(t, model) for t in found):
            return found
        tried = {name: self.attempt(name, model) for name in resorts}
        vain = [name for name, trial in tried.items() if trial is None or not self.admissible(trial, model)]
        self._in_vain |= dict.fromkeys(vain, left)
        return found + [trial for trial in tried.values() if trial is not None]

    def _attempt_in_turn(self, names: list[str], model: EchoModel) -> list[Trial]:
        """The simple ones first; the richer ones where none of those explains so much that no other could be preferred to it."""
        found: list[Trial] = []
        for complexity in sorted({find(name).complexity for name in names}):
            level = [name for name in names if find(name).complexity == complexity]
            if any(self._settles(trial, model) for trial in found):
                self._spared.update(level)
            else:
                found += [trial for name in level if (trial := self.attempt(name, model)) is not None]
        return found

    def _settles(self, trial: Trial, model: EchoModel) -> bool:
        """Whether a trial on a model can be named and leaves next to nothing."""
        little = self.left(trial.model) <= self.criteria.nothing * self.left(model)
        return little and self.explained(trial.model) and self.admissible(trial, model)

    def admissible(self, trial: Trial, model: EchoModel) -> bool:
        """Whether a trial on a model explains enough to be named, and its values look like that effect."""
        return not self.short_of(trial, model)

    def short_of(self, trial: Trial, model: EchoModel) -> str:
        """The bar that a trial on a model does not reach, in words; empty where it is admissible."""
        if trial.p_value > self.criteria.false_rate:
            return f"{percent(trial.p_value)} of ordinary recordings show as much of some effect"
        if trial.name in dict(self._start.effects):  # known to be there: it may be weaker now, or gone
            return ""
        evidence = Evidence(trial.values, model, self.scorer, self.score(model), trial.score)
        return "" if find(trial.name).plausible(evidence) else "its values do not look like it"

    def tried(self, start: EchoModel, model: EchoModel) -> tuple[Tried, ...]:
        """All effects that were fitted, beside the start or elsewhere, with what came of them, and those that were spared; nothing is fitted anew."""
        names_tried = {name: None for _, name in self._trials}
        found = []
        for name in names_tried:
            alone = self._trials.get((signature(start), name))
            others = frozenset(dict(self.less(model, name).effects))
            short = self.short_of(alone, start) if alone else ""
            found.append(Tried(name, alone, self._alike.get((others, name)), short, self._failed.get(name, "")))
        spared = [name for name in names() if name in self._spared and name not in names_tried]
        return (*found, *(Tried(name, None, None, spared=True) for name in spared))

    def preferred(self, trials: Iterable[Trial]) -> Trial | None:
        """Of admissible trials the simplest of those that no other outdoes; None where none lowers the level."""
        trials = [trial for trial in trials if trial.gain_db > 0.0]
        enough = [one for one in trials if not any(self._outdoes(other, one) for other in trials)]
        return min(enough, key=lambda trial: (find(trial.name).complexity, -trial.gain_db), default=None)

    def _outdoes(self, one: Trial, other: Trial) -> bool:
        """Whether one explains more than another, by more than chance; a flexible one by more than it takes up of whatever is left."""
        by_chance = p_value(one.name, one.gain_db - other.gain_db) > self.criteria.false_rate
        taken_up = find(one.name).flexible and other.gain_db >= self.criteria.nearly * one.gain_db
        return not (by_chance or taken_up)

    def absent(self, model: EchoModel, most: int) -> list[str]:
        """Names of the effects that a model has not, or as the start has them, that may be tried and whose complexity is at most `most`."""
        out = {*added(self._start, model), *self._without}
        return [n for n in names() if n not in out and find(n).complexity <= most and not find(n).free]

    def less(self, model: EchoModel, name: str) -> EchoModel:
        """The model without what it has of that effect beyond the start."""
        return less(self._start, model, name)


def added(start: EchoModel, model: EchoModel) -> list[str]:
    """Names of the effects that a model has beyond the start it was made from, or at other values, the latest last."""
    known = dict(start.effects)
    return [name for name, values in model.effects if known.get(name) is not values]


def less(start: EchoModel, model: EchoModel, name: str) -> EchoModel:
    """The model without that effect, or with it as the start has it."""
    kept = tuple(entry for entry in start.effects if entry[0] == name)
    return replace(model, effects=(*kept, *model.without_effect(name).effects))


def signature(model: EchoModel) -> Signature:
    """By which models with the same effects at the same values are known: they predict the same, in whichever order these were fitted."""
    return tuple(
        sorted(
            (name, *(np.asarray(value, float).tobytes() for _, value in sorted(values.items())))
            for name, values in model.effects
        )
    )


def _over_fan(level_db: float) -> float:
    """Power over the fan's, the fan taken off."""
    return max(10 ** (level_db / 10) - 1.0, 0.0)
