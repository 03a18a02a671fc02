"""One effect tried on a model of a recording: what it explains on held-out samples, and whether that is enough to name it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import NamedTuple, TypeAlias

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import own_p_value, p_value
from edgefilter.diagnosis.straightened import Score, Straightened, share_of
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import EFFECTS, find, names
from edgefilter.echo.measurement import STEADY_DB, Values
from edgefilter.echo.model import EchoModel
from edgefilter.errors import UsageError

AHEAD = next(one.name for one in EFFECTS if one.free and one.family == "linear path" and one.stage == "source")
"""A linear filter ahead of a nonlinear loudspeaker. Without a nonlinearity it is the same as one behind it, and is not tried."""
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

    failed: why its fit failed. spared: whether it was not even fitted, since what is left is too little for it to be named.
    """

    name: str
    alone: Trial | None
    beside: Trial | None
    failed: str = ""
    spared: bool = False


class Reading(NamedTuple):
    """The listed effect that a free law is known by, and the share of the law's gain that its few numbers bring, 0 to 1."""

    name: str
    share: float


@dataclass(frozen=True, eq=False)
class Found:
    """The outcome of a search from a start model.

    steps: the accepted effects in their order. notes: what the reader must know of the search. tried: every effect that
    was fitted. like: of a free law the name that it replaces.
    """

    recording: Straightened
    start: EchoModel
    model: EchoModel
    base: Score
    final: Score
    steps: tuple[Trial, ...]
    notes: tuple[str, ...] = ()
    tried: tuple[Tried, ...] = ()
    like: Mapping[str, Reading] = field(default_factory=dict)

    def with_only(self, values: Mapping[str, Values]) -> Found:
        """The outcome with nothing but these effects, each with what it explains beside those before it."""
        steps = steps_of(self.recording.of, self.start, values)
        model, score = (steps[-1].model, steps[-1].score) if steps else (self.start, self.base)
        return replace(self, model=model, final=score, steps=steps)

    @cached_property
    def in_noise(self) -> Straightened:
        """The recording with the fan that was found."""
        return self.recording.behind(self.model)


class Workbench:
    """Tries effects on models of one recording and remembers what came of it."""

    def __init__(
        self,
        recording: Straightened,
        criteria: Criteria,
        progress: Callable[[str], None] | None = None,
        without: Collection[str] = (),
        start: EchoModel | None = None,
    ) -> None:
        self.recording, self.criteria = recording, criteria
        self._start = start or recording.model
        # a profile made from the recording itself (self_calibrate) has some effects at neutral values: what they would explain
        # is in its path or fan already, so they are not tried
        taken_up = (name for name, values in self._start.effects if vanishes(find(name), values))
        self._without = {*without, *taken_up}
        self._progress = progress
        self._scores: dict[tuple[Signature, bool], Score] = {}
        self._trials: dict[tuple[Signature, str], Trial | None] = {}
        self._alike: dict[tuple[frozenset[str], str], Trial | None] = {}
        self._failed: dict[str, str] = {}
        self._spared: set[str] = set()
        self._refused, self._so_far = False, ""

    @property
    def notes(self) -> tuple[str, ...]:
        """What could not be tried, and why."""
        spent = f"the search was stopped after {len(self._trials)} fits: something further may be in the recording"
        return (*self._failed.values(), *((spent,) if self._refused else ()))

    def so_far(self, model: EchoModel) -> None:
        """Tell with what is tried next what a model has beyond the start, and what it leaves."""
        if names := added(self._start, model):
            self._so_far = f"; so far {' and '.join(names)}: {self.score(model).excess_db:.1f} dB left"

    def score(self, model: EchoModel, any_volume: bool = False) -> Score:
        """The score of a model (Straightened.of), worked out once."""
        key = signature(model), any_volume
        if key not in self._scores:
            self._scores[key] = self.recording.of(model, any_volume)
        return self._scores[key]

    def off_db(self, model: EchoModel) -> float:
        """How far what a model leaves is from the noise that it expects, dB.

        While the robot is heard, over its silences, of half a dB either way; or in these, less by what a fan differs
        from day to day.
        """
        score = self.score(model)
        told = score.active_db - float(np.clip(score.silent_db, -0.5, 0.5))
        return max(told, abs(self.recording.silences_db(score)) - STEADY_DB)

    def explained(self, model: EchoModel) -> bool:
        """Whether a model leaves so little while the robot is heard that nothing further can be told in it."""
        return self.off_db(model) <= self.criteria.heard_db

    def little(self, model: EchoModel) -> bool:
        """Whether a model leaves so little of what the profile leaves that the right effects may be in it."""
        was, left = (self.score(each).active_db for each in (self.recording.model, model))
        gone = left <= 0.0 or share_of(was, left) >= self.criteria.nearly
        return gone and self.off_db(model) <= self.criteria.little_db

    def left(self, model: EchoModel) -> float:
        """Level in dB over that of the silences, with what noise costs that no waveform predicts."""
        score = self.score(model)
        return max((score.level_db if noisy(model) else score.over_db) - score.floor_db, 0.0)

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
            if len(self._trials) >= self.criteria.most_fits:
                self._refused = True
                return None
            self._trials[key] = self._alike[frozenset(dict(model.effects)), name] = self._attempt(name, model)
        return self._trials[key]

    def _in_reach(self, name: str, model: EchoModel) -> bool:
        """Whether an effect could be named beside a model if it explained all that this leaves, over the silences or over the fan."""
        most = max(self.left(model), abs(self.score(model).over_db))
        return p_value(name, most) <= self.criteria.false_rate

    def _attempt(self, name: str, model: EchoModel) -> Trial | None:
        if self._progress:
            self._progress(f"trying {name}{self._so_far}")
        effect, others = find(name), model.without_effect(name)
        try:
            values = self.recording.fitted(name, others)
        except (UsageError, ArithmeticError, np.linalg.LinAlgError) as error:
            self._failed[name] = f"{name} could not be fitted and was left out: {error}"
            return None
        if vanishes(effect, values) and name not in dict(model.effects):
            return None
        trial = self.beside(name, model, model.with_effect(name, values))
        if effect.family != "time":
            return trial
        # what a lag explains at the wrong volume is no measure of it: any filter that mutes the voice would explain more
        before, after = (self.score(each, any_volume=True).level_db for each in (model, trial.model))
        return replace(trial, gain_db=max(trial.gain_db, before - after))

    def beside(self, name: str, others: EchoModel, model: EchoModel) -> Trial:
        """What the effect of that name explains that model has and others has not."""
        before, after = self.score(others), self.score(model)
        return Trial.of(name, model, before, after)

    def halves(self, trial: Trial, model: EchoModel) -> bool:
        """Whether a trial takes away half of the power over the fan, though the level hardly falls, as a narrow ring does, in few cells."""
        return share_of(self.score(model).active_db, trial.score.active_db) > self.criteria.half

    def attempt_simpler(self, name: str, model: EchoModel, rigid: bool = False) -> list[Trial]:
        """Try each simpler effect of the family of the effect `name`.

        rigid: leave out effects with many free parameters, since any two such effects can imitate each other.
        """
        rich, known = find(name), [find(other) for other in self.absent(model)]
        simpler = [one for one in known if one.family == rich.family and one.complexity < rich.complexity]
        return self._attempt_in_turn([one.name for one in simpler if not (rigid and one.flexible)], model)

    def attempt_all(self, model: EchoModel) -> list[Trial]:
        """Try each effect that the model lacks, but for the last resorts."""
        return self._attempt_in_turn([name for name in self.absent(model) if not find(name).last_resort], model)

    def attempt_last(self, model: EchoModel) -> list[Trial]:
        """Try each of the last resorts that the model lacks."""
        resorts = (name for name in self.absent(model) if find(name).last_resort)
        return [trial for name in resorts if (trial := self.attempt(name, model))]

    def filtered_ahead(self, model: EchoModel) -> EchoModel | None:
        """The model in which one filter ahead of the loudspeaker replaces those behind it; the room is refitted. None if no filter is behind it."""
        has = added(self._start, model)
        filters = [name for name in has if find(name).absorbed and find(name).stage != "source"]
        if AHEAD in has or not filters:
            return None
        ahead = self.attempt(AHEAD, reduce(self.less, filters, model))
        if ahead and (room := next((name for name in filters if find(name).stage == "response"), None)):
            ahead = self.attempt(room, ahead.model)
        return ahead.model if ahead else None

    def known_by(self, law: Trial) -> Reading | None:
        """The named effect, a filter of the path, that explains most of what the filter fitted in `law` explains; None where neither does."""
        start = self._start
        listed = [name for name in names() if (one := find(name)).stage == "path" and one.absorbed and not one.free]
        best = max(
            (fit for one in listed if (fit := self.attempt(one, start))), key=lambda fit: fit.gain_db, default=None
        )
        alone = self.beside(law.name, start, start.with_effect(law.name, law.values))
        return Reading(best.name, min(best.gain_db / alone.gain_db, 1.0)) if best and alone.gain_db > 0.0 else None

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
        little = self.left(trial.model) <= (1.0 - self.criteria.nearly) * self.left(model)
        return little and self.explained(trial.model) and self.admissible(trial)

    def worth(self, trial: Trial, model: EchoModel) -> bool:
        """Whether a trial on a model can be named and explains a good part of what that leaves."""
        much = trial.gain_db >= self.criteria.part * self.left(model) or self.halves(trial, model)
        return much and self.admissible(trial)

    def admissible(self, trial: Trial) -> bool:
        """Whether a trial explains enough to be named."""
        return trial.p_value <= self.criteria.false_rate

    def tried(self, start: EchoModel, model: EchoModel) -> tuple[Tried, ...]:
        """All effects that were fitted, beside the start or elsewhere, with what came of them, and those that were spared; nothing is fitted anew."""
        names_tried = {name: None for _, name in self._trials if not find(name).free}
        found = []
        for name in names_tried:
            alone = self._trials.get((signature(start), name))
            others = frozenset(dict(self.less(model, name).effects))
            found.append(Tried(name, alone, self._alike.get((others, name)), self._failed.get(name, "")))
        spared = [name for name in names() if name in self._spared and name not in names_tried]
        return (*found, *(Tried(name, None, None, spared=True) for name in spared))

    def preferred(self, trials: Iterable[Trial]) -> Trial | None:
        """The simplest of the admissible trials that no other outdoes; None where none lowers the residual's level."""
        trials = [trial for trial in trials if trial.gain_db > 0.0]
        enough = [one for one in trials if not any(self._outdoes(other, one) for other in trials)]
        return min(enough, key=lambda trial: (find(trial.name).complexity, -trial.gain_db), default=None)

    def _outdoes(self, one: Trial, other: Trial) -> bool:
        """Whether `one` explains more than `other`, beyond chance; if `one` is flexible, by more than what it takes up of any residual."""
        by_chance = own_p_value(one.name, one.gain_db - other.gain_db) > self.criteria.false_rate
        taken_up = find(one.name).flexible and other.gain_db >= self.criteria.nearly * one.gain_db
        return not (by_chance or taken_up)

    def absent(self, model: EchoModel) -> list[str]:
        """Names of the effects that may be tried: those that the model lacks, or still has with the values of the start."""
        out = {*added(self._start, model), *self._without}
        return [name for name in names() if name not in out and not find(name).free]

    def less(self, model: EchoModel, name: str) -> EchoModel:
        """The model without that effect, or with it as the model had it from which the search began."""
        return less(self._start, model, name)


def steps_of(score: Callable[[EchoModel], Score], start: EchoModel, values: Mapping[str, Values]) -> tuple[Trial, ...]:
    """Effects added to a model one after the other, each with what it explains beside those before it."""
    steps, before = [], score(start)
    for name, of in values.items():
        start = start.with_effect(name, of)
        steps.append(Trial.of(name, start, before, score(start)))
        before = steps[-1].score
    return tuple(steps)


def added(start: EchoModel, model: EchoModel) -> list[str]:
    """Names of the effects that a model has beyond the start it was made from, or at other values, the latest last."""
    known = dict(start.effects)
    return [name for name, values in model.effects if known.get(name) is not values]


def noisy(model: EchoModel) -> bool:
    """Whether a model expects noise that no waveform predicts: that fits whatever is left."""
    return any(find(name).adds_noise for name, _ in model.effects)


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
