"""Stepwise selection of the effects that a profile lacks: forward, refit, backward, on held-out samples (Efroymson 1960).

Forward: every effect is fitted beside those accepted so far, and the simplest of those that no other outdoes is
accepted. Refit: all are fitted beside each other. Backward: what the newest one has made superfluous is exchanged for
something simpler, or dropped. Stepwise selection ends in local optima; so it is begun anew from the next best effects
where the best one does not lead to an explanation.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import pairwise

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.trials import Found, Trial, Workbench, added
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel

FULL = "the search ended at {} effects with some error left: something further may be in the recording"


def search(
    prepared: Prepared,
    model: EchoModel,
    criteria: Criteria,
    progress: Callable[[str], None] | None = None,
    without: Collection[str] = (),
) -> Found:
    """Add effects, others than those named in without, to model as long as held-out samples say that they are there."""
    bench = Workbench(prepared, criteria, progress, without, model)
    best = _best(bench, model, list(_runs(bench, model)))
    steps = _in_steps(bench, model, best)
    full = len(added(model, best)) >= criteria.most_effects and not bench.explained(best)
    notes = (*bench.notes, FULL.format(criteria.most_effects)) if full else bench.notes
    return Found(prepared, model, best, bench.score(model), bench.score(best), steps, notes, bench.tried(model, best))


def _runs(bench: Workbench, start: EchoModel) -> Iterator[EchoModel]:
    """What each beginning leads to, until one explains nearly all: of all its steps, what explains most by effects that can be named."""
    criteria = bench.criteria
    known: set[frozenset[str]] = set()
    for first in _starts(bench, start):
        steps = [standing(bench, start, step) for step in _stepwise(bench, start, first, known)]
        run = min(steps, key=lambda step: bench.score(step).level_db)
        yield run
        if (
            bench.explained(run)
            or bench.left(run) <= (1.0 - criteria.nearly) * bench.left(start)
            or bench.little(run, start)
        ):
            return


def _starts(bench: Workbench, start: EchoModel) -> Iterator[Trial]:
    """The trial to begin with, then others that explain a good part of something else, named or not: what hides them may be found beside them."""
    criteria = bench.criteria
    if bench.off_db(start) <= criteria.silent_db:
        return
    trials = bench.attempt_all(start)
    first = bench.preferred(t for t in trials if bench.admissible(t, start))
    if first is not None:
        yield first
    least = criteria.part * bench.left(start)
    others = [t for t in trials if t is not first and not find(t.name).last_resort and t.gain_db >= least]
    others = [t for t in others if first is None or not _same(bench, start, first, t)]
    yield from sorted(others, key=lambda t: -t.gain_db)[: criteria.starts]


def _same(bench: Workbench, start: EchoModel, one: Trial, other: Trial) -> bool:
    """Whether two effects are two names for the same: as much is left by both, and beside either the other explains next to nothing."""
    if bench.halves(other, one.model) or bench.halves(one, other.model):
        return False
    least = bench.criteria.nothing * bench.left(start)
    pairs = ((one, other.name), (other, one.name))
    return all((again := bench.attempt_alike(name, t.model)) is None or again.gain_db < least for t, name in pairs)


def _stepwise(bench: Workbench, start: EchoModel, first: Trial, known: set[frozenset[str]]) -> Iterator[EchoModel]:
    """The model with first, then step by step with what explains a good part of what is left.

    known: the sets of effects that earlier runs have held, which those of this one join: where it meets an earlier run, it ends.
    """
    model = split(bench, start, first.model)
    known.add(frozenset(added(start, model)))
    yield model
    while len(added(start, model)) < bench.criteria.most_effects and not bench.explained(model):
        bench.so_far(model)
        newest = forward(bench, model) or doubtful(bench, model)
        if newest is None or (held := frozenset(added(start, newest.model))) in known:
            break
        known.add(held)
        grown = split(bench, start, backward(bench, start, refit(bench, start, newest.model), newest.name))
        if bench.score(grown).level_db >= bench.score(model).level_db:
            break
        model = grown
        yield model
        known.add(frozenset(added(start, model)))


def forward(bench: Workbench, model: EchoModel, most: int = 9) -> Trial | None:
    """The effect to accept next: it explains a good part of what is left, and looks like what it is."""
    return bench.preferred(t for t in _much(bench, model, most) if bench.admissible(t, model))


def doubtful(bench: Workbench, model: EchoModel) -> Trial | None:
    """The effect to go on with where none looks like what it is: it may not do so before another one is found beside it."""
    return bench.preferred(t for t in _much(bench, model, 9) if t.p_value <= bench.criteria.false_rate)


def _much(bench: Workbench, model: EchoModel, most: int) -> list[Trial]:
    """Trials that explain a good part of what is left."""
    least = bench.criteria.part * bench.left(model)
    return [t for t in bench.attempt_all(model, most) if t.gain_db >= least or bench.halves(t, model)]


def refit(bench: Workbench, start: EchoModel, model: EchoModel) -> EchoModel:
    """Each effect beyond start fitted beside the others, in turn, as long as the held-out level falls."""
    listed, worth = added(start, model), bench.criteria.worth_db
    if len(listed) < 2:
        return model
    waiting = listed[:-1]  # the newest was just fitted beside them
    for _ in range(bench.criteria.rounds):
        before = bench.score(model).level_db
        for name in waiting:
            again = bench.attempt(name, bench.less(model, name))
            if again is not None and again.score.level_db < bench.score(model).level_db - 0.5 * worth:
                model = again.model
        if before - bench.score(model).level_db < worth:
            break
        waiting = listed
    return model


def backward(bench: Workbench, start: EchoModel, model: EchoModel, newest: str) -> EchoModel:
    """The model without what the newest effect has made superfluous: an earlier one exchanged for the one to name beside it, or dropped."""
    earlier = [name for name in added(start, model) if name != newest]
    for name in earlier:
        model = _exchange(bench, start, model, name)
    for name in [name for name in earlier if name in dict(model.effects)]:
        alone = bench.attempt(newest, bench.less(bench.less(model, name), newest))
        if alone is None:
            continue
        gain_db = alone.score.level_db - bench.score(model).level_db
        if p_value(name, gain_db) > bench.criteria.false_rate:
            model = alone.model
    return model


def _exchange(bench: Workbench, start: EchoModel, model: EchoModel, name: str) -> EchoModel:
    """The model with another effect instead of that one where, beside the others, the other is the one to name."""
    others = bench.less(model, name)
    trials = bench.attempt_all(others, find(name).complexity)
    rivals = [t for t in trials if t.name != name and not find(t.name).last_resort and bench.admissible(t, others)]
    chosen = bench.preferred([*rivals, bench.beside(name, others, model)])
    if chosen is None or chosen.name == name:
        return model
    changed = refit(bench, start, chosen.model)
    without = bench.score(others).level_db
    most = without - bench.score(model).level_db
    return changed if without - bench.score(changed).level_db > bench.criteria.nearly * most else model


def split(bench: Workbench, start: EchoModel, model: EchoModel) -> EchoModel:
    """The model with a simple effect beside each one whose fit has taken that up as well."""
    for name in added(start, model):
        apart = _apart(bench, model, name)
        if apart is not model and standing(bench, start, apart) is apart:
            model = apart
    return model


def _apart(bench: Workbench, model: EchoModel, name: str) -> EchoModel:
    """The model with a simple effect beside the one of that name, where its fit has taken that one up as well; or as it is."""
    effect, values, others = find(name), dict(model.effects)[name], bench.less(model, name)
    only = effect.only(values)
    bare = others.with_effect(name, only)
    simple = None if only is values else forward(bench, bare, bench.criteria.simple)
    if simple is None:
        return model
    grown = both = simple.model
    for _ in range(bench.criteria.rounds):
        fitted = bench.attempt(name, bench.less(grown, name))
        if fitted is None:
            return model
        both = fitted.model
        again = bench.attempt(simple.name, bench.less(both.with_effect(name, effect.only(fitted.values)), simple.name))
        if again is None:
            return model
        grown = again.model
    lost, left = (bench.score(m).level_db - bench.score(model).level_db for m in (bare, grown))
    return both if left <= (1.0 - bench.criteria.nearly) * lost else model


def _best(bench: Workbench, start: EchoModel, runs: list[EchoModel]) -> EchoModel:
    """The run that explains most, or the earlier and simpler one where others hardly explain more."""
    base = bench.score(start).level_db
    best = start
    for run in sorted(runs, key=lambda run: sum(find(name).complexity for name in added(start, run))):
        most = base - bench.score(run).level_db
        if base - bench.score(best).level_db < bench.criteria.nearly * most:
            best = run
    return best


def standing(bench: Workbench, start: EchoModel, run: EchoModel) -> EchoModel:
    """The run without the effects that cannot be named beside its others, the latest first."""
    while fallen := [name for name in added(start, run) if not _stands(bench, run, name)]:
        run = bench.less(run, fallen[-1])
    return run


def _stands(bench: Workbench, model: EchoModel, name: str) -> bool:
    """Whether an effect can be named beside the model's others."""
    others = bench.less(model, name)
    return bench.admissible(bench.beside(name, others, model), others)


def _in_steps(bench: Workbench, start: EchoModel, model: EchoModel) -> tuple[Trial, ...]:
    """The effects that a model has beyond the start, each with what it explains beside those before it.

    First comes the one that is missed most; where the excess does not fall from step to step so, the largest.
    """
    found = added(start, model)
    missed = sorted(found, key=lambda name: -_left_without(bench, start, model, name))
    steps = _steps(bench, start, model, missed)
    excess = [bench.score(start).excess_db, *(step.score.excess_db for step in steps)]
    if all(after <= before for before, after in pairwise(excess)):
        return steps
    left, order, with_them, values = list(found), [], start, dict(model.effects)
    while left:
        tries = {name: with_them.with_effect(name, values[name]) for name in left}
        order.append(min(tries, key=lambda name: bench.score(tries[name]).level_db))
        with_them = tries[order[-1]]
        left.remove(order[-1])
    return _steps(bench, start, model, order)


def _left_without(bench: Workbench, start: EchoModel, model: EchoModel, name: str) -> float:
    """Level in dB that a model leaves without that effect, the others fitted anew: what these could swallow is not its own."""
    others = bench.less(model, name)
    kept = added(start, others)
    if len(kept) != 1:
        return bench.score(refit(bench, start, others)).level_db
    alone = bench.attempt(kept[0], start)
    return min(bench.score(others).level_db, alone.score.level_db if alone else float("inf"))


def _steps(bench: Workbench, start: EchoModel, model: EchoModel, order: Sequence[str]) -> tuple[Trial, ...]:
    """The effects of a model beyond the start in that order."""
    steps, values = [], dict(model.effects)
    for name in order:
        grown = start.with_effect(name, values[name])
        steps.append(bench.beside(name, start, grown))
        start = grown
    return tuple(steps)
