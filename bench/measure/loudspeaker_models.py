"""Models of a loudspeaker's distortion that are compared: what they add to a drive, and how one is fitted beside a path."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from edgefilter.dsp.membrane import displacement_taps, motion
from edgefilter.echo.effect import complete, vanishes
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.loudspeaker_fit import EXCURSION, KNEES, PEAK, RESONANCES_HZ
from edgefilter.echo.effects.loudspeaker_laws import amplifier_terms, driver_terms
from edgefilter.echo.effects.path_and_loudspeaker import (
    ROUNDS,
    first_path,
    fit_path_and_loudspeaker,
    hearing,
    refined_path,
)
from edgefilter.echo.least_squares import NUISANCE_LEAD, NUISANCE_TAPS, filtered, normal_equations, short_filter
from edgefilter.echo.measurement import level_ratio, whiten
from edgefilter.types import SAMPLE_RATE, Array, Samples

RIDGE = 1e-3
TAPS = 16
PATH_TAPS = 8000
EFFECT = find("speaker_nonlinearity")
Play = Callable[[Samples], Samples]


@dataclass(frozen=True)
class Model:
    """Terms with a filter of some taps each.

    terms: what a setting makes of a drive (n,), (k, n). settings: those to try, from a drive.
    """

    terms: Callable[[Samples, tuple[float, ...]], Iterable[Samples]]
    settings: Callable[[Samples], list[tuple[float, ...]]]
    taps: int = 1


def products(x: Samples, _: tuple[float, ...]) -> list[Samples]:
    """x^2, x^3, x |x|, d x, d^2 x with the displacement d below 300 Hz: the effect until now."""
    d = short_filter(x, displacement_taps().astype(np.float32))[: x.size]
    return [x * x, x * x * x, x * np.abs(x), d * x, d * d * x]


def two_products(x: Samples, setting: tuple[float, ...]) -> list[Samples]:
    """Those of the running filter: d x, d^2 x."""
    return products(x, setting)[3:]


def plain(_: Samples) -> list[tuple[float, ...]]:
    return [()]


def knees(x: Samples) -> list[tuple[float, ...]]:
    return [(share * float(np.quantile(np.abs(x), PEAK)),) for share in KNEES]


def membranes(x: Samples) -> list[tuple[float, ...]]:
    return [(hz, EXCURSION * float(np.quantile(np.abs(motion(x, hz)[0]), PEAK))) for hz in RESONANCES_HZ]


MODELS = {
    "d x, d^2 x": Model(two_products, plain),
    "products": Model(products, plain),
    f"products, {TAPS} taps": Model(products, plain, TAPS),
    "bounded, memoryless": Model(lambda x, s: amplifier_terms(x, s[0]), knees),
    "driver": Model(lambda x, s: driver_terms(x, s[0], s[1]), membranes),
    "driver and amplifier": Model(
        lambda x, s: [*driver_terms(x, s[0], s[1]), *amplifier_terms(x, s[2])],
        lambda x: [(*membrane, *knees(x)[0]) for membrane in membranes(x)],
    ),
}


def path_alone(x: Samples, y: Samples) -> Array:
    """The linear path, refined as often as beside the models."""
    weights = np.ones(y.size, np.float32)
    response = first_path(x, y, weights, PATH_TAPS)
    for _ in range(ROUNDS + 1):
        response, _ = refined_path(x, y, weights, response)
    return response


def fit_model(model: Model, x: Samples, y: Samples) -> tuple[Array, Play]:
    """A path and what plays ahead of it, fitted in turns, without a guard."""
    weights = np.ones(y.size, np.float32)
    response, noise = refined_path(x, y, weights, first_path(x, y, weights, PATH_TAPS))
    settings = model.settings(x)

    def play(sound: Samples) -> Samples:
        return sound + filtered(list(model.terms(sound, setting)), found)

    for _ in range(ROUNDS):
        found, setting = min(
            (solve(model, setting, x, y, response, noise) for setting in settings), key=lambda tried: tried[2]
        )[:2]
        settings = [setting]
        response, noise = refined_path(play(x), y, weights, response)
    return response, play


def solve(
    model: Model, setting: tuple[float, ...], x: Samples, y: Samples, response: Array, noise: Samples
) -> tuple[Array, tuple[float, ...], float]:
    """Weights (k, taps) of a model's terms ahead of a path, the setting, and the energy that they leave."""
    hear = hearing(response, noise)
    linear = hear(x)
    early = np.concatenate((linear[NUISANCE_LEAD:], np.zeros(NUISANCE_LEAD, np.float32)))
    voice = [late(early, k) for k in range(NUISANCE_TAPS)]
    heard = [late(term, k) for term in map(hear, model.terms(x, setting)) for k in range(model.taps)]
    weights, left = normal_equations([*voice, *heard], whiten(y, noise), 1).solve(RIDGE)
    gain = level_ratio(filtered(voice, weights[:NUISANCE_TAPS]), linear) or 1.0
    return weights[NUISANCE_TAPS:].reshape(-1, model.taps) / gain, setting, left


def late(x: Samples, samples: int) -> Samples:
    """X (n,) that many samples later."""
    return np.concatenate((np.zeros(samples, np.float32), x[: x.size - samples]))


def fit_effect(x: Samples, y: Samples) -> tuple[Array, Play | None]:
    """The effect as the package fits it; None where its guard leaves it neutral."""
    response, values = fit_path_and_loudspeaker(x, y, taps=PATH_TAPS)
    return response, None if vanishes(EFFECT, values) else (lambda sound: EFFECT.apply(sound, values, SAMPLE_RATE))


def fit_from_sweep(sweep: tuple[Samples, Samples], x: Samples, y: Samples) -> tuple[Array, Play | None]:
    """The effect from a sweep alone, then the path from x to y behind it."""
    _, values = fit_path_and_loudspeaker(*sweep, taps=PATH_TAPS)
    if vanishes(EFFECT, values):
        return path_alone(x, y), None
    known = complete(EFFECT, values)
    return path_alone(EFFECT.apply(x, known, SAMPLE_RATE), y), lambda sound: EFFECT.apply(sound, known, SAMPLE_RATE)
