"""Whether the fan is another than at the calibration, or held down: before the search, and without the robot's voice."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.leftover import Leftover, inspect
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.score import Scorer
from edgefilter.diagnosis.trials import Found, Trial, beside
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.evidence import Score
from edgefilter.echo.measurement import Measurement, Values
from edgefilter.echo.model import EchoModel


def changed_fan(
    prepared: Prepared, model: EchoModel, base: Score, criteria: Criteria, without: Collection[str] = ()
) -> tuple[Prepared, Trial] | None:
    """The recording prepared with the fan as the robot's silences have it, and what changed it as a step; else None.

    Only where there are silences and the fan is steady in them, which it is not behind a gain that moves. Where the fan is
    held down only while the robot is silent, the calibrated one stays; not so by an effect named in without.
    """
    held_down = _held_down(prepared, model, criteria, without)
    if held_down is not None:
        return prepared, held_down
    residual = (prepared.measurement.recording - base.prediction) / model.microphone_gain(base.prediction.size)
    left = inspect(prepared, residual)
    if not np.isfinite(left.quiet_mean_db) or left.mains_hz:
        return None
    for name, values, now in _other_fans(prepared, prepared.measurement, model):
        most = max(_change_db(prepared, now), left.quiet_mean_db)
        if most < criteria.fan_change_db or not _steady(inspect(now, residual), criteria):
            continue
        step = _step(now, name, values, model, base)
        if abs(step.score.silent_db) < 0.5 * abs(base.silent_db) and step.p_value <= criteria.false_rate:
            return now, step
    return None


def look_at_fan(found: Found, criteria: Criteria, without: Collection[str] = ()) -> tuple[Found, Leftover]:
    """The search's outcome with the final residual held against the fan as it is now, and with what changed the fan.

    A microphone gain in the model is taken out of the residual first: the fan passed through it. without: names of
    effects that are not to be looked for beside the voice.
    """
    found = _scored_anew(found, criteria, without)
    prepared, model = found.prepared, found.model
    heard_as = prepared.measurement.recording
    gain = model.microphone_gain(heard_as.size)
    residual = (heard_as - found.final.prediction) / gain
    left = inspect(prepared, residual)
    if any(find(name).is_of_the_fan for name, _ in model.effects) or left.mains_hz:
        return found, left
    heard = bool(np.isfinite(left.quiet_mean_db))
    if heard and abs(left.quiet_mean_db) <= 0.5 * criteria.fan_change_db:
        return found, left
    for name, values, now in _other_fans(prepared, replace(prepared.measurement, recording=heard_as / gain), model):
        change = _change_db(prepared, now)
        if abs(max(change, left.quiet_mean_db) if heard else change) < criteria.fan_change_db:
            continue
        behind = inspect(now, residual)
        if not _steady(behind, criteria):
            continue
        step = _step(now, name, values, model, found.final)
        after = step.score
        if (after.silent_db > 0.5 * found.final.silent_db) if heard else (after.excess_db > criteria.fan_change_db):
            continue
        if step.p_value <= criteria.false_rate:
            changed = replace(found, prepared=now, model=step.model, final=after, steps=(*found.steps, step))
            return changed, behind
    return found, left


def without_doubtful(found: Found) -> Found:
    """The outcome of a search that explains too little, with nothing but what silences and voice both show."""
    return _in_steps(found, tuple(step for step in found.steps if find(step.name).shows_in_silence))


def _held_down(prepared: Prepared, model: EchoModel, criteria: Criteria, without: Collection[str]) -> Trial | None:
    """The first effect that shows in the robot's silences as well and that a model lacks, as a step from it."""
    scorer = Scorer(prepared)
    sought = sorted(name for name in names() if find(name).shows_in_silence and name not in without)
    return next((step for name in sought if (step := beside(scorer, name, model, criteria))), None)


def _scored_anew(found: Found, criteria: Criteria, without: Collection[str]) -> Found:
    """The search's outcome with what shows in the silences fitted and scored beside all that was found."""
    kept = tuple(step for step in found.steps if not find(step.name).shows_in_silence)
    model = found.model
    for name in {step.name for step in found.steps} - {step.name for step in kept}:
        model = model.without_effect(name)
    held_down = _held_down(found.prepared, model, criteria, without)
    if held_down is None and kept == found.steps:
        return found
    return _in_steps(found, kept if held_down is None else (held_down, *kept))


def _in_steps(found: Found, steps: Iterable[Trial]) -> Found:
    """The outcome with those effects alone, each scored beside those before it."""
    scorer, model, score, scored = Scorer(found.prepared), found.start, found.base, []
    for step in steps:
        model, before = model.with_effect(step.name, step.values), score
        score = scorer.of(model)
        again = Trial.of(step.name, model, before, score)
        scored.append(replace(again, gain_db=step.gain_db) if find(step.name).stage == "noise" else again)
    return replace(found, model=model, final=score, steps=tuple(scored))


def _other_fans(
    prepared: Prepared, measurement: Measurement, model: EchoModel
) -> Iterator[tuple[str, Values, Prepared]]:
    """Each effect on the noise that a model has not, fitted to a measurement, and the recording with that fan."""
    for name in names():
        if find(name).stage == "noise" and name not in dict(model.effects):
            values = model.fitted(name, measurement)
            yield name, values, prepared.behind(find(name).noise_psd(values, prepared.noise_psd))


def _step(now: Prepared, name: str, values: Values, model: EchoModel, before: Score) -> Trial:
    """An effect on the noise as a step from a model, scored with the fan as that has it."""
    scorer = Scorer(now)
    after = scorer.of(model)
    return Trial(name, values, model.with_effect(name, values), after, scorer.fan_gain_db(before, after))


def _steady(left: Leftover, criteria: Criteria) -> bool:
    """Whether what is left of the silences, whitened by the new fan's spectrum, is a fan; True where there are none."""
    return left.swing_db < criteria.fan_steady_db


def _change_db(before: Prepared, after: Prepared) -> float:
    """Change of the fan's whole power."""
    was, now = (float(np.sum(prepared.noise_psd, dtype=np.float64)) for prepared in (before, after))
    return 10.0 * np.log10(now / was)
