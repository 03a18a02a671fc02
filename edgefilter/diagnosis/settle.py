"""Several effects at once: fitted again beside each other, exchanged for simpler ones, dropped where the others explain as much."""

from __future__ import annotations

from edgefilter.diagnosis.suspects import choose
from edgefilter.diagnosis.trials import Workbench, absent, added
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.model import EchoModel

ROUNDS, WORTH_DB = 3, 0.02
"""Rounds of fitting each effect beside the others, and the fall in level below which no further one is worth its time."""
SIMPLE = 1
"""Complexity up to which an effect is simple beside any flexible one."""
HEARD_DB = 0.4
"""A gain in a filter's passband that is more than an ordinary tolerance and the fit's error."""
CONFIRMED = 0.1
"""Of the level that a flexible effect leaves, what a simpler one beside it must explain."""


def settle(bench: Workbench, start: EchoModel, model: EchoModel) -> EchoModel:
    """The model with its effects beyond start fitted beside each other; exchanged or dropped where that is simpler and explains as much."""
    *earlier, newest = added(start, model)
    model = refit(bench, start, model)
    for name in earlier if not bench.tired else ():
        model = _exchange(bench, start, model, name)
    return _drop(bench, model, [name for name in earlier if name in dict(model.effects)], newest)


def refit(bench: Workbench, start: EchoModel, model: EchoModel) -> EchoModel:
    """Each effect beyond start fitted beside the others, in turn, as long as the held-out level falls."""
    fitted = added(start, model)
    if len(fitted) < 2:
        return model
    waiting = fitted[:-1]
    for _ in range(ROUNDS):
        before = bench.verdict(model).level_db
        for name in waiting:
            again = bench.attempt(name, model.without_effect(name))
            if again is not None and again.verdict.level_db < bench.verdict(model).level_db - 0.5 * WORTH_DB:
                model = again.model
        if before - bench.verdict(model).level_db < WORTH_DB:
            break
        waiting = fitted
    return model


def _exchange(bench: Workbench, start: EchoModel, model: EchoModel, name: str) -> EchoModel:
    """The model with another effect instead of that one where, beside the others, the other is the one to name."""
    others = model.without_effect(name)
    trials = {t.name: t for t in bench.attempt_all(others, find(name).complexity) if not find(t.name).last_resort and bench.admissible(t, others)}
    trials[name] = bench.beside(name, others, model)
    chosen = choose({key: trial.gain_db for key, trial in trials.items()})
    if chosen is None or chosen == name:
        return model
    changed = refit(bench, start, trials[chosen].model)
    most = bench.verdict(others).level_db - bench.verdict(model).level_db
    return changed if bench.verdict(others).level_db - bench.verdict(changed).level_db > 0.85 * most else model


def _drop(bench: Workbench, model: EchoModel, earlier: list[str], newest: str) -> EchoModel:
    """The model without the earlier effects that the newest one, fitted without them, explains as well."""
    for name in earlier:
        alone = bench.attempt(newest, model.without_effect(name).without_effect(newest))
        if alone is not None and alone.verdict.level_db - bench.verdict(model).level_db < find(name).least_gain_db:
            model = alone.model
    return model


def _volume_beside(bench: Workbench, model: EchoModel) -> EchoModel:
    """The model with the gain that a filter has in its passband as a turned volume beside it, where that explains as much."""
    for name, values in model.effects:
        gain_db = find(name).passband_gain_db(values)
        if gain_db is None or abs(gain_db) < HEARD_DB:
            continue
        gains = [(other, plain) for other in names() if (plain := find(other).plain_gain(gain_db)) is not None and other not in dict(model.effects)]
        for other, plain in gains:
            both = bench.attempt(name, model.without_effect(name).with_effect(other, plain))
            if both is not None and both.verdict.level_db < bench.verdict(model).level_db + WORTH_DB:
                return both.model
    return model


def simpler_beside(bench: Workbench, start: EchoModel, model: EchoModel) -> EchoModel:
    """The model with a simpler effect beside a flexible one where both together explain more than the flexible one alone."""
    model = _volume_beside(bench, model)
    for name in [name for name in added(start, model) if find(name).flexible]:
        others = model.without_effect(name)
        if len(added(start, model)) > 2 or bench.tired or bench.explained(others):
            break
        wanted = [key for key in absent(others, max(find(name).complexity - 1, SIMPLE)) if not (find(key).flexible or find(key).last_resort)]
        simple = [t for key in wanted if (t := bench.attempt_alike(key, others)) is not None and bench.admissible(t, others)]
        least = max(CONFIRMED * bench.left(model), 0.05)
        for trial in sorted(simple, key=lambda t: -t.gain_db)[:2]:
            both = bench.attempt(name, trial.model)
            if both is None or not bench.admissible(both, trial.model):
                continue
            joint = refit(bench, start, both.model)
            confirmed = bench.beside(trial.name, model, joint)
            if confirmed.gain_db >= least and bench.admissible(confirmed, joint.without_effect(trial.name)):
                model = joint
                break
    return model
