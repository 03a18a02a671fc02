"""One effect tried on a model of a recording: what it explains on held-out samples, and whether that is enough to name it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.score import Judge
from edgefilter.dsp.frames import decibels
from edgefilter.dsp.psd import total_power
from edgefilter.echo.effect import complete
from edgefilter.echo.effect import neutral as neutral_values
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.evidence import Evidence, Score
from edgefilter.echo.measurement import Values, whiten
from edgefilter.echo.model import EchoModel
from edgefilter.errors import UsageError
from edgefilter.types import Samples

ENOUGH, LITTLE_DB = 0.4, 0.1
"""A last resort is tried where no other explains this share of the level above the silences, and where that is no less than so much."""

HEARD_DB, FAN_DB = 0.6, 0.2
"""Where the residual is no more than the first above that of the robot's silences, or no more than the second above the calibrated fan, there is
nothing beside the effects that were found, whose models err a little."""
DEAR = 60
"""Sum of the costs of all fits after which only what is in plain sight is looked for."""

POWER_SHARE = 0.6
"""Of the power over the fan, what an effect may leave at most that takes about half of it away."""
LONG = 4
"""Complexity of long filters: half a minute does not teach all their taps, so what they leave of the samples fitted to says little."""

Signature: TypeAlias = tuple[tuple[str | bytes, ...], ...]


@dataclass(frozen=True, eq=False)
class Trial:
    """One effect added to a model: its values, the model with it, what the judge says, and its size over the fan in dB."""

    name: str
    values: Values
    model: EchoModel
    verdict: Score
    gain_db: float
    size_db: float


@dataclass(frozen=True, eq=False)
class Found:
    """The outcome of a search from a start model. steps: the accepted effects in their order.

    prepared: what final was judged on; its fan is another than at the calibration where fan_noise is the first of the steps.
    """

    prepared: Prepared
    start: EchoModel
    model: EchoModel
    base: Score
    final: Score
    steps: tuple[Trial, ...]


class Workbench:
    """Tries effects on models of one prepared recording and remembers what came of it."""

    def __init__(self, prepared: Prepared, progress: Callable[[str], None] | None = None) -> None:
        self.prepared = prepared
        self.judge = Judge(prepared)
        self._progress = progress
        self._verdicts: dict[Signature, Score] = {}
        self._trials: dict[tuple[Signature, str], Trial | None] = {}
        self._cost = 0
        self._alike: dict[tuple[frozenset[str], str], Trial | None] = {}

    def verdict(self, model: EchoModel) -> Score:
        """What the judge says of a model."""
        key = signature(model)
        if key not in self._verdicts:
            self._verdicts[key] = self.judge.of(model)
        return self._verdicts[key]

    def heard(self, model: EchoModel) -> float:
        """dB over the robot's silences, of half a dB either way, that a model leaves while the robot is heard."""
        verdict = self.verdict(model)
        return verdict.active_db - float(np.clip(verdict.silent_db, -0.5, 0.5))

    def explained(self, model: EchoModel) -> bool:
        """Whether a model leaves so little while the robot is heard that nothing further can be told in it."""
        return self.heard(model) <= HEARD_DB or self.verdict(model).active_db <= FAN_DB

    def left(self, model: EchoModel) -> float:
        """Level in dB over that of the silences."""
        verdict = self.verdict(model)
        return max(verdict.level_db - floor_level(self.judge, verdict), 0.0)

    def attempt(self, name: str, model: EchoModel) -> Trial | None:
        """The effect of that name fitted beside what the model has; None where its fit finds nothing."""
        key = signature(model), name
        if key not in self._trials:
            self._trials[key] = self._attempt(name, model)
            self._cost += find(name).cost
            self._alike[frozenset(dict(model.effects)), name] = self._trials[key]
        return self._trials[key]

    @property
    def tired(self) -> bool:
        """Whether so much was tried that a doubtful case is left as it is."""
        return self._cost >= DEAR

    def attempt_alike(self, name: str, model: EchoModel) -> Trial | None:
        """attempt(), or what came of it beside the same effects at other values: enough to choose what is worth a closer look."""
        key = frozenset(dict(model.effects)), name
        return self._alike[key] if key in self._alike else self.attempt(name, model)

    def _attempt(self, name: str, model: EchoModel) -> Trial | None:
        if self._progress:
            self._progress(f"trying {name}")
        effect = find(name)
        try:
            values = complete(effect, effect.fit(self.prepared.measurement, model))
        except (UsageError, ArithmeticError, np.linalg.LinAlgError) as error:
            warnings.warn(f"{name} could not be fitted and is left out: {error}", stacklevel=2)
            return None
        if all(np.array_equal(values[key], neutral) for key, neutral in neutral_values(effect).items()):
            return None
        return self.beside(name, model, model.with_effect(name, values))

    def beside(self, name: str, others: EchoModel, model: EchoModel) -> Trial:
        """What the effect of that name explains that model has and others has not."""
        before, after = self.verdict(others), self.verdict(model)
        size = max(size_db(after.prediction - before.prediction, self.prepared), noise_size_db(name, model, self.prepared))
        return Trial(name, dict(model.effects)[name], model, after, before.level_db - after.level_db, size)

    def halves(self, trial: Trial, model: EchoModel) -> bool:
        """Whether a trial takes away about half of the power over the fan, though the level hardly falls.

        A narrow ring does so, in few cells. Beside a long filter an effect may do so where that filter was fitted and so leaves no more
        than there is besides: of the held-out samples the filter itself leaves the most.
        """
        before, after = self.verdict(model), trial.verdict
        where_fitted = find(trial.name).complexity < LONG and _over_fan(after.fitted_db) < POWER_SHARE * _over_fan(before.fitted_db)
        return where_fitted or _over_fan(after.active_db) < POWER_SHARE * _over_fan(before.active_db)

    def attempt_all(self, model: EchoModel, most: int = 9) -> list[Trial]:
        """Each effect that the model has not and whose complexity is at most `most`.

        The last resorts only where none of the others explains much of what is left.
        """
        found, left = [], self.left(model)
        for name in sorted(absent(model, most), key=lambda name: find(name).last_resort):
            if find(name).last_resort and (self.tired or left < LITTLE_DB):
                continue
            if find(name).last_resort and any((t.gain_db > ENOUGH * left or self.halves(t, model)) and self.admissible(t, model) for t in found):
                continue
            if (trial := self.attempt(name, model)) is not None:
                found.append(trial)
        return found

    def admissible(self, trial: Trial, model: EchoModel) -> bool:
        """Whether a trial on a model explains enough to be named, and its values look like that effect."""
        effect = find(trial.name)
        if trial.gain_db < effect.least_gain_db or trial.size_db < effect.least_size_db:
            return False
        return effect.plausible(Evidence(trial.values, model, self.judge, self.verdict(model), trial.verdict))


def absent(model: EchoModel, most: int) -> list[str]:
    """Names of the effects on the voice that a model has not and whose complexity is at most `most`."""
    return [name for name in names() if find(name).stage != "noise" and name not in dict(model.effects) and find(name).complexity <= most]


def added(start: EchoModel, model: EchoModel) -> list[str]:
    """Names of the effects that a model has beyond the start it was made from, the latest last."""
    return [name for name, _ in model.effects[len(start.effects) :]]


def _over_fan(level_db: float) -> float:
    """Power over the fan's, the fan taken off."""
    return max(10 ** (level_db / 10) - 1.0, 0.0)


def signature(model: EchoModel) -> Signature:
    """By which models with the same effects at the same values are known, in whichever order these were fitted."""
    return tuple(sorted((name, *(np.asarray(value, float).tobytes() for _, value in sorted(values.items()))) for name, values in model.effects))


def floor_level(judge: Judge, verdict: Score) -> float:
    """Level in dB of the cells in which the robot is silent, 0 where it never is: what is left when everything is explained."""
    quiet = verdict.cells[~judge.active_cells]
    if quiet.shape[0] < 4:
        return 0.0
    return float(np.average(decibels(quiet, 1e-3).mean(axis=0), weights=judge.freedom))


def size_db(change: Samples, prepared: Prepared) -> float:
    """Power of a change of the prediction (n,) over the fan in dB: as it is or whitened, whichever is more."""
    psd = prepared.measurement.noise_psd
    fan = total_power(psd)
    plain, white = float(np.mean(change.astype(float) ** 2)) / fan, float(np.mean(whiten(change, psd).astype(float) ** 2))
    return float(decibels(max(plain, white)))


def noise_size_db(name: str, model: EchoModel, prepared: Prepared) -> float:
    """Mean power over the fan, in dB, of what the model says of that effect that no waveform predicts."""
    if not find(name).adds_noise:
        return -120.0
    psd = prepared.measurement.noise_psd
    fan = total_power(psd)
    power = sum(float(np.mean(variance)) for variance, _ in model.unpredictable(prepared.measurement.reference))
    return float(decibels(power / fan))
