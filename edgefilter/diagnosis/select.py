"""The search for missing effects: try all, accept the best, look again, take back what has become superfluous or was taken for another."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from edgefilter.diagnosis.noise_change import changed_fan
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.settle import settle, simpler_beside
from edgefilter.diagnosis.suspects import choose
from edgefilter.diagnosis.trials import LONG, Found, Trial, Workbench, added
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel

MOST_EFFECTS = 3
SCREEN_DB = 0.2
"""Where the residual is no more than this above that of the robot's silences, there is nothing of the voice in it; half a dB over the fan in the
silences is ordinary, more of it may be a microphone's gain."""
SECOND_SHARE = 0.2
"""Of the excess level that is left, a further effect has to explain at least this share: less is how the first one's model errs."""
STARTS, START_SHARE = 2, 0.1
"""Further effects to begin with where the best one has not led to an explanation, and the share of the level that each must explain by itself."""
SIMPLE_SHARE = 0.3
"""Of the level that one long filter explains, what a simple effect must explain to be taken for half of it."""
NEARLY = 0.85
"""Share of the level that is explained where no other start is tried."""
BETTER = 0.05
"""Of the level explained, what another start must explain more to be preferred."""


def search(prepared: Prepared, model: EchoModel, progress: Callable[[str], None] | None = None) -> Found:
    """Add effects to model as long as held-out samples say that they are there.

    Greedy from the effect that explains most by itself, and where that does not lead to an explanation from the next ones: of two
    effects at once, the louder may hide what speaks for the other, and a third may look most like both.
    """
    bench, start = Workbench(prepared, progress), model
    base = bench.verdict(model)
    fan = changed_fan(prepared, model, base)
    if fan is not None:
        prepared, step = fan
        bench, model = Workbench(prepared, progress), step.model
    runs: list[EchoModel] = []
    for first in _starts(bench, model):
        runs.append(_grow(bench, model, first))
        if bench.tired or bench.explained(runs[-1]) or bench.left(runs[-1]) <= (1.0 - NEARLY) * bench.left(model):
            runs.extend(_grow(bench, model, simple, LONG - 1) for simple in _simpler_start(bench, model, runs[-1]))
            break
    best = _best(bench, model, runs)
    steps = _in_steps(bench, model, best)
    return Found(prepared, start, best, base, bench.verdict(best), ((step, *steps) if fan is not None else steps))


def _starts(bench: Workbench, model: EchoModel) -> Iterator[Trial]:
    """The trial to begin with, then others that explain a good part, named or not, since what hides them may be found beside them."""
    if bench.heard(model) <= SCREEN_DB:
        return
    trials = bench.attempt_all(model)
    admissible = {t.name: t for t in trials if bench.admissible(t, model)}
    name = choose({key: trial.gain_db for key, trial in admissible.items()})
    if name is not None:
        yield admissible[name]
    least = max(START_SHARE * bench.left(model), 0.1)
    others = sorted((t for t in trials if t.name != name and not find(t.name).last_resort and t.gain_db >= least), key=lambda t: -t.gain_db)
    yield from others[:STARTS]


def _simpler_start(bench: Workbench, start: EchoModel, run: EchoModel) -> list[Trial]:
    """The simple effect, none or one, that explains a good part of what one long filter does: two of them may look like that filter."""
    found = added(start, run)
    if bench.tired or len(found) != 1 or find(found[0]).complexity < LONG:
        return []
    most = bench.verdict(start).level_db - bench.verdict(run).level_db
    simple = [t for t in bench.attempt_all(start, 1) if t.gain_db >= SIMPLE_SHARE * most and bench.admissible(t, start)]
    return sorted(simple, key=lambda t: -t.gain_db)[:1]


def _grow(bench: Workbench, start: EchoModel, first: Trial, most: int = 9) -> EchoModel:
    """The model with first and all of complexity up to `most` that can be named beside it."""
    model = simpler_beside(bench, start, first.model)
    while len(added(start, model)) < MOST_EFFECTS and not bench.explained(model):
        least = SECOND_SHARE * bench.left(model)
        much = [t for t in bench.attempt_all(model, most) if t.gain_db >= least or bench.halves(t, model)]
        admissible = {t.name: t for t in much if bench.admissible(t, model)}
        name = choose({key: trial.gain_db for key, trial in admissible.items()})
        if name is None:
            break
        model, before = settle(bench, start, admissible[name].model), model
        model = simpler_beside(bench, start, model)
        if bench.verdict(model).level_db >= bench.verdict(before).level_db:
            model = before
            break
    return model


def _best(bench: Workbench, start: EchoModel, runs: list[EchoModel]) -> EchoModel:
    """The run that explains most of those whose effects can all be named; the earlier and simpler one where others hardly explain more."""
    base = bench.verdict(start).level_db
    valid = [_standing(bench, start, run) for run in runs]
    best = start
    for run in sorted(valid, key=lambda run: sum(find(name).complexity for name in added(start, run))):
        most = base - bench.verdict(best).level_db
        if base - bench.verdict(run).level_db > most + BETTER * abs(most):
            best = run
    return best


def _standing(bench: Workbench, start: EchoModel, run: EchoModel) -> EchoModel:
    """The run without the effects that cannot be named beside its others, the latest first."""
    while fallen := [name for name in added(start, run) if not _stands(bench, run, name)]:
        run = run.without_effect(fallen[-1])
    return run


def _stands(bench: Workbench, model: EchoModel, name: str) -> bool:
    """Whether an effect can be named beside the model's others."""
    others = model.without_effect(name)
    return bench.admissible(bench.beside(name, others, model), others)


def _in_steps(bench: Workbench, start: EchoModel, model: EchoModel) -> tuple[Trial, ...]:
    """The effects that a model has beyond the start, each with what it explains beside those before it, the largest first."""
    names, steps = added(start, model), []
    values, model = dict(model.effects), start
    while names:
        tries = {name: model.with_effect(name, values[name]) for name in names}
        name = min(tries, key=lambda name: bench.verdict(tries[name]).level_db)
        steps.append(bench.beside(name, model, tries[name]))
        model = tries[name]
        names.remove(name)
    return tuple(steps)
