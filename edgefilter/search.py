"""The search for missing effects: try all, accept the best, look again, take back what has become superfluous."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from edgefilter.echo.effect import Values, complete, find, names, whiten
from edgefilter.echo.effect import neutral as neutral_values
from edgefilter.echo.model import EchoModel
from edgefilter.errors import UsageError
from edgefilter.judge import Judge, Verdict
from edgefilter.prepare import Prepared
from edgefilter.suspects import OWN, SUSPECTS, choose
from edgefilter.types import SAMPLE_RATE, Samples

MOST_EFFECTS = 3
LAST, ENOUGH = ("rattle",), 0.4
"""Effects whose fit takes long, and the share of the excess level at which another one has explained it."""
SCREEN_DB = 0.2
"""Where the residual is no more than this above that of the robot's silences, there is nothing of the voice in it; half a dB
over the fan in these is ordinary, more of it may be a microphone's gain."""
SECOND_SHARE = 0.2
"""Of the excess level that is left, a further effect has to explain at least this share: less is how the first one's model errs."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One effect added to a model: its values, the model with it, what the judge says, and its size over the fan in dB."""

    name: str
    values: Values
    model: EchoModel
    verdict: Verdict
    gain_db: float
    size_db: float


@dataclass(frozen=True, eq=False)
class Found:
    """The outcome of a search from a start model. steps: the accepted effects in their order."""

    start: EchoModel
    model: EchoModel
    base: Verdict
    final: Verdict
    steps: tuple[Trial, ...]


def search(prepared: Prepared, model: EchoModel, progress: Callable[[str], None] | None = None) -> Found:
    """Add effects to model as long as held-out samples say that they are there."""
    judge = Judge(prepared)
    start = model
    base = current = judge.of(model)
    steps: list[Trial] = []
    while len(steps) < MOST_EFFECTS and current.active_db - float(np.clip(current.silent_db, -0.5, 0.5)) > SCREEN_DB:
        left = max(current.level_db - floor_level(judge, current), 0.0)
        trials = _try_all(prepared, model, judge, current, left, progress)
        admissible = {t.name: t for t in trials if _admissible(t, judge, current) and (not steps or t.gain_db >= SECOND_SHARE * left)}
        name = choose({key: trial.gain_db for key, trial in admissible.items()})
        if name is None:
            break
        steps.append(admissible[name])
        model, current = admissible[name].model, admissible[name].verdict
        if len(steps) > 1:
            model, current, steps = _settle(prepared, judge, model, current, steps, progress)
    return Found(start, model, base, current, tuple(steps))


def _try_all(
    prepared: Prepared, model: EchoModel, judge: Judge, current: Verdict, left: float, progress: Callable[[str], None] | None
) -> list[Trial]:
    """Each effect that the model has not; the LAST ones only where none of the others explains nearly all of what is left."""
    trials: list[Trial] = []
    wanted = [name for name in names() if find(name).stage != "noise" and name not in dict(model.effects)]
    for name in sorted(wanted, key=lambda name: name in LAST):
        if name in LAST and any(t.gain_db > ENOUGH * left and _admissible(t, judge, current) for t in trials):
            continue
        trial = _try(name, prepared, model, judge, current, progress)
        if trial is not None:
            trials.append(trial)
    return trials


def predict(model: EchoModel, prepared: Prepared) -> Samples:
    """(n,) of the model for the prepared reference."""
    return model.predict(prepared.measurement.reference)


def floor_level(judge: Judge, verdict: Verdict) -> float:
    """Level in dB of the cells in which the robot is silent, 0 where it never is: what is left when everything is explained."""
    quiet = verdict.cells[~judge.active_cells]
    if quiet.shape[0] < 4:
        return 0.0
    return float(np.average(10 * np.log10(np.maximum(quiet, 1e-3)).mean(axis=0), weights=judge.freedom))


def _try(
    name: str, prepared: Prepared, model: EchoModel, judge: Judge, before: Verdict, progress: Callable[[str], None] | None
) -> Trial | None:
    if progress:
        progress(f"trying {name}")
    effect = find(name)
    try:
        values = complete(effect, effect.fit(prepared.measurement, model))
    except (UsageError, ArithmeticError, np.linalg.LinAlgError) as error:
        warnings.warn(f"{name} could not be fitted and is left out: {error}", stacklevel=2)
        return None
    if all(np.array_equal(values[key], neutral) for key, neutral in neutral_values(effect).items()):
        return None
    fitted = model.with_effect(name, values)
    verdict = judge.of(fitted)
    size = max(size_db(verdict.prediction - before.prediction, prepared), noise_size_db(fitted, prepared))
    return Trial(name, values, fitted, verdict, before.level_db - verdict.level_db, size)


def size_db(change: Samples, prepared: Prepared) -> float:
    """Power of a change of the prediction (n,) over the fan in dB: as it is or whitened, whichever is more."""
    psd = prepared.measurement.noise_psd
    fan = float(psd.sum()) * 8000.0 / (psd.size - 1)
    plain, white = float(np.mean(change.astype(float) ** 2)) / fan, float(np.mean(whiten(change, psd).astype(float) ** 2))
    return float(10 * np.log10(max(plain, white, 1e-12)))


def noise_size_db(model: EchoModel, prepared: Prepared) -> float:
    """Mean power over the fan, in dB, of what the model says that no waveform predicts."""
    psd = prepared.measurement.noise_psd
    fan = float(psd.sum()) * (SAMPLE_RATE / 2) / (psd.size - 1)
    power = sum(float(np.mean(variance)) for variance, _ in model.unpredictable(prepared.measurement.reference))
    return float(10 * np.log10(max(power / fan, 1e-12)))


def _admissible(trial: Trial, judge: Judge, before: Verdict) -> bool:
    rule = SUSPECTS.get(trial.name, OWN)
    if trial.gain_db < rule.least_gain_db or trial.size_db < rule.least_size_db:
        return False
    return rule.guard is None or rule.guard(trial.values, judge, before, trial.verdict)


def _settle(
    prepared: Prepared, judge: Judge, model: EchoModel, current: Verdict, steps: list[Trial], progress: Callable[[str], None] | None
) -> tuple[EchoModel, Verdict, list[Trial]]:
    """Fit the earlier effects again beside the new one; drop those without which the rest explains as much."""
    for earlier in steps[:-1]:
        again = _try(earlier.name, prepared, model.without_effect(earlier.name), judge, current, progress)
        if again is not None and again.verdict.level_db < current.level_db:
            model, current = again.model, again.verdict
    for step in list(steps[:-1]):
        newest = steps[-1].name
        alone = _try(newest, prepared, model.without_effect(step.name).without_effect(newest), judge, current, progress)
        rule = SUSPECTS.get(step.name, OWN)
        if alone is not None and -alone.gain_db < rule.least_gain_db:
            model, current = alone.model, alone.verdict
            steps = [kept for kept in steps if kept.name != step.name]
    return model, current, _judged_again(prepared, judge, model, steps)


def _judged_again(prepared: Prepared, judge: Judge, model: EchoModel, steps: list[Trial]) -> list[Trial]:
    """The steps with the values that they have in the end, each judged beside those before it."""
    settled = []
    for step in reversed(steps):
        values = dict(model.effects)[step.name]
        settled.append(replace(step, values=values, model=model, verdict=judge.of(model)))
        model = model.without_effect(step.name)
    return settled[::-1]
