"""Effects fitted beside each other to a recording, and to a straight one: drift, jumps and volume taken out first."""

from __future__ import annotations

from collections.abc import Sequence

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.select import refit, standing
from edgefilter.diagnosis.straightened import Straightened
from edgefilter.diagnosis.trials import Workbench
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.model import EchoModel


def fit_jointly(measurement: Measurement, model: EchoModel, wanted: Sequence[str]) -> EchoModel:
    """The model with those effects, each fitted with the others in place, in turn, until the error no longer falls.

    A drift or a jump of the measurement has to be in the model already, or wanted: else a long filter fits nothing.
    """
    best, least = model, float("inf")
    for _ in range(Criteria.rounds if len(wanted) > 1 else 1):
        for name in wanted:
            model = model.fit(name, measurement)
        error = measurement.error(measurement.predicted(model)[0])
        if error < least:
            best, before, least = model, least, error
            if 10 ** (Criteria.worth_db / 10) * error < before:
                continue
        break
    return best


def fit_straight(prepared: Straightened, wanted: Sequence[str]) -> tuple[EchoModel, tuple[str, ...]]:
    """The prepared recording's model with those effects, fitted jointly, and with what the running filter follows.

    The names of the latter are the second answer: a drift or a turned volume of this recording would spoil the fit of the
    others. Looked for twice, since beside the wrong room it may be hidden.
    """
    followed = _followed(wanted)
    start = prepared.model.without_effect(*followed)  # the profile's own too: here they may have other values
    bench = Workbench(prepared, Criteria(), start=start)
    model = _straightened(bench, start, followed)
    fitted, order = _forward(bench, model, wanted)
    model = _straightened(bench, fitted, followed)
    found = tuple(name for name in followed if name in dict(model.effects))
    return fit_jointly(prepared.fitted_to(prepared.usable).measurement, model, [*found, *order]), found


def _forward(bench: Workbench, model: EchoModel, wanted: Sequence[str]) -> tuple[EchoModel, list[str]]:
    """The model with the wanted effects, and their order: always the simplest next of those that no other outdoes.

    In another order an effect settles on what the one after it should have explained. Last come those of which a fit to
    half of the recording finds nothing.
    """
    order: list[str] = []
    while left := [name for name in wanted if name not in order]:
        newest = bench.preferred(trial for name in left if (trial := bench.attempt(name, model.without_effect(name))))
        if newest is None:
            return model, [*order, *left]
        model = newest.model
        order.append(newest.name)
    return model, order


def _followed(wanted: Sequence[str]) -> list[str]:
    """Names of the effects that the running filter follows, without noise, the wanted ones and those that a wanted one includes.

    A flexible effect on the path includes the volume: beside it a gain could have any value. A lag over time of the user's own
    includes the drift of the clocks. Noise changes no fit.
    """
    wished = [find(name) for name in wanted]
    left = {
        "additive noise",
        *("linear path" for effect in wished if effect.stage in ("response", "path") and effect.flexible),
        *("time" for effect in wished if effect.family == "time" and not effect.followed),
    }
    return [name for name in names() if find(name).followed and name not in wanted and find(name).family not in left]


def _straightened(bench: Workbench, model: EchoModel, followed: Sequence[str]) -> EchoModel:
    """The model with only those of the followed effects that held-out samples show: forward, refitted, backward."""
    start = model = model.without_effect(*followed)
    while True:
        absent = [name for name in followed if name not in dict(model.effects)]
        trials = [trial for name in absent if (trial := bench.attempt(name, model)) is not None]
        newest = bench.preferred(trial for trial in trials if bench.admissible(trial))
        if newest is None:
            return standing(bench, start, model)
        model = refit(bench, start, newest.model)
