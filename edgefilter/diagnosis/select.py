"""Stepwise selection of the effects that a profile lacks: forward, refit, backward, on held-out samples (Efroymson 1960).

Forward: every effect is fitted beside those accepted so far, and the simplest of those that no other outdoes is
accepted. Refit: all are fitted beside each other. Backward: what the newest one has made superfluous is exchanged for
something simpler, or dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from itertools import pairwise

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.straightened import Straightened
from edgefilter.diagnosis.trials import AHEAD, Found, Trial, Workbench, added, noisy, steps_of
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel

FULL = "the search ended at {} effects with some error left: something further may be in the recording"


def search(
    recording: Straightened,
    model: EchoModel,
    criteria: Criteria,
    progress: Callable[[str], None] | None = None,
    without: Collection[str] = (),
) -> Found:
    """Add effects, others than those named in without, to model as long as held-out samples say that they are there."""
    bench = Workbench(recording, criteria, progress, without, model)
    best = min(_stepwise(bench, model), key=lambda step: bench.score(step).level_db)
    steps = _in_steps(bench, model, best)
    full = len(steps) >= criteria.most_effects and not bench.explained(best)
    notes = (*bench.notes, FULL.format(criteria.most_effects)) if full else bench.notes
    like = {step.name: reading for step in steps if find(step.name).free and (reading := bench.known_by(step))}
    return Found(
        recording, model, best, bench.score(model), bench.score(best), steps, notes, bench.tried(model, best), like
    )


def _stepwise(bench: Workbench, start: EchoModel) -> Iterator[EchoModel]:
    """The start, then step by step with what explains a good part of what is left, of each step what can be named.

    Beside noise that explains all a waveform is looked for once more: it may explain some of that.
    """
    yield start
    model, enough_db = start, bench.criteria.silent_db
    while len(added(start, model)) < bench.criteria.most_effects and (bench.off_db(model) > enough_db or noisy(model)):
        bench.so_far(model)
        newest = forward(bench, start, model)
        if newest is None:
            return
        before_db, grown = bench.score(model).level_db, refit(bench, start, newest.model)
        simpler = split(bench, start, backward(bench, start, grown, newest.name))
        lower = [each for each in (simpler, grown) if bench.score(each).level_db < before_db]
        if not lower:
            return
        model, enough_db = lower[0], bench.criteria.heard_db
        yield standing(bench, start, model)


def forward(bench: Workbench, start: EchoModel, model: EchoModel) -> Trial | None:
    """The effect to accept next: it explains a good part of what is left.

    Where that is much, a nonlinear loudspeaker is tried behind the filters as well, and noise where nothing else explains it.
    """
    found = [trial for trial in bench.attempt_all(model) if bench.worth(trial, model)]
    if not bench.little(model) and all(find(trial.name).learned for trial in found):
        found += [trial for trial in _behind_a_filter(bench, start, model) if bench.worth(trial, model)]
        found = found or [trial for trial in bench.attempt_last(model) if bench.worth(trial, model)]
    return bench.preferred(found)


def _behind_a_filter(bench: Workbench, start: EchoModel, model: EchoModel) -> Iterator[Trial]:
    """Two kinds of trial: the model's filter moved ahead of the loudspeaker, and that with a nonlinear loudspeaker behind it.

    Which of filter and loudspeaker comes first shows only in the distortion products. So all effects of a trial are refitted before
    it is judged.
    """
    moved, before = bench.filtered_ahead(model), bench.score(model)
    if moved is None:
        return
    yield Trial.of(AHEAD, moved, before, bench.score(moved))
    for name in bench.absent(moved):
        if find(name).learned and (bent := bench.attempt(name, moved)):
            together = refit(bench, start, bent.model)
            if standing(bench, start, together) is together:
                yield Trial.of(name, together, before, bench.score(together))


def refit(bench: Workbench, start: EchoModel, model: EchoModel) -> EchoModel:
    """Refit each effect that was added to start, in turn, while the others stay as they are (backfitting).

    Rounds go on as long as a whole round lowers the held-out level; a single fit in it may raise that.
    """
    listed, worth = added(start, model), bench.criteria.worth_db
    if len(listed) < 2:
        return model
    waiting = listed[:-1]  # the newest was just fitted beside them
    for _ in range(bench.criteria.rounds):
        again = model
        for name in waiting:
            fitted = bench.attempt(name, bench.less(again, name))
            again = fitted.model if fitted else again
        if bench.score(model).level_db - bench.score(again).level_db < worth:
            break
        model, waiting = again, listed
    return model


def backward(bench: Workbench, start: EchoModel, model: EchoModel, newest: str) -> EchoModel:
    """The model without what the newest effect has made superfluous: an earlier one exchanged for the one to name beside it, or dropped."""
    for name in [name for name in added(start, model) if name != newest and not find(name).free]:
        model = _exchange(bench, start, model, name)
    return without_superfluous(bench, start, model, newest)


def without_superfluous(bench: Workbench, start: EchoModel, model: EchoModel, newest: str) -> EchoModel:
    """The model without each effect that it does not need: without it the newest effect, fitted anew, explains as much, within chance."""
    for name in [name for name in added(start, model) if name != newest]:
        alone = bench.attempt(newest, bench.less(bench.less(model, name), newest))
        if alone is None:
            continue
        gain_db = alone.score.level_db - bench.score(model).level_db
        if p_value(name, gain_db) > bench.criteria.false_rate:
            model = alone.model
    return model


def _exchange(bench: Workbench, start: EchoModel, model: EchoModel, name: str) -> EchoModel:
    """The model with a simpler effect instead of that one where, beside the others, the simpler one is the one to name."""
    others = bench.less(model, name)
    rivals = [trial for trial in bench.attempt_simpler(name, others) if bench.admissible(trial)]
    chosen = bench.preferred([*rivals, bench.beside(name, others, model)])
    if chosen is None or chosen.name == name:
        return model
    changed = refit(bench, start, chosen.model)
    without = bench.score(others).level_db
    most = without - bench.score(model).level_db
    return changed if without - bench.score(changed).level_db > bench.criteria.nearly * most else model


def split(bench: Workbench, start: EchoModel, model: EchoModel) -> EchoModel:
    """The model, with a simpler effect added beside each effect whose fit had imitated that simpler one."""
    for name in added(start, model):
        apart = _apart(bench, model, name)
        if apart is not model and standing(bench, start, apart) is apart:
            model = apart
    return model


def _apart(bench: Workbench, model: EchoModel, name: str) -> EchoModel:
    """The model with a simpler effect beside the effect `name`, if that one's fit has imitated it as well; otherwise as it is."""
    effect, values, others = find(name), dict(model.effects)[name], bench.less(model, name)
    only = effect.only(values)
    if only is values:
        return model
    bare = others.with_effect(name, only)
    simpler = bench.attempt_simpler(name, bare, rigid=True)
    simple = bench.preferred(trial for trial in simpler if bench.worth(trial, bare))
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
        before, grown = bench.score(grown).level_db, again.model
        if before - bench.score(grown).level_db < bench.criteria.worth_db:
            break
    lost, left = (bench.score(m).level_db - bench.score(model).level_db for m in (bare, grown))
    return both if left <= (1.0 - bench.criteria.nearly) * lost else model


def standing(bench: Workbench, start: EchoModel, run: EchoModel) -> EchoModel:
    """The run without the effects that cannot be named beside its others, the latest first."""
    beside = [bench.beside(name, bench.less(run, name), run) for name in added(start, run)]
    fallen = [trial.name for trial in beside if not bench.admissible(trial)]
    return standing(bench, start, bench.less(run, fallen[-1])) if fallen else run


def _in_steps(bench: Workbench, start: EchoModel, model: EchoModel) -> tuple[Trial, ...]:
    """The effects that a model has beyond the start, each with what it explains beside those before it.

    First comes the one that is missed most; where the excess does not fall from step to step so, the largest.
    """
    found = added(start, model)
    missed = sorted(found, key=lambda name: -_left_without(bench, start, model, name))
    values = dict(model.effects)
    steps = steps_of(bench.score, start, {name: values[name] for name in missed})
    excess = [bench.score(start).excess_db, *(step.score.excess_db for step in steps)]
    if all(after <= before for before, after in pairwise(excess)):
        return steps
    left, order, with_them = list(found), [], start
    while left:
        tries = {name: with_them.with_effect(name, values[name]) for name in left}
        order.append(min(tries, key=lambda name: bench.score(tries[name]).level_db))
        with_them = tries[order[-1]]
        left.remove(order[-1])
    return steps_of(bench.score, start, {name: values[name] for name in order})


def _left_without(bench: Workbench, start: EchoModel, model: EchoModel, name: str) -> float:
    """Level in dB that a model leaves without that effect, the others fitted anew: what these could swallow is not its own."""
    others = bench.less(model, name)
    kept = added(start, others)
    if len(kept) != 1:
        return bench.score(refit(bench, start, others)).level_db
    alone = bench.attempt(kept[0], start)
    return min(bench.score(others).level_db, alone.score.level_db if alone else float("inf"))
