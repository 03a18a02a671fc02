"""What a comparison says of recordings, number by number, and the sounds that a probe plays: as it was before."""

from collections.abc import Callable

import numpy as np
import pytest

from edgefilter import compare
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.probe import menu
from edgefilter.echo.model import EchoModel
from tests.as_before import levels_db, same_as_before
from tests.diagnosis.robot_scene import path, profile, record, voice


def bent(x: np.ndarray) -> np.ndarray:
    return record((np.tanh(4.0 * x + 0.3) / 4.0).astype(np.float32))


def with_effect(name: str, **values: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda x: record(x, EchoModel(path()).with_effect(name, values))


HAPPENED = {
    "bent": bent,
    "turned_down": with_effect("playback_gain", gain_db=-4.0),
    "elsewhere": lambda x: record(x, EchoModel(path(seed=2))),
    "later": lambda x: record(x, lag=37.4),
}


def interrupted(x: np.ndarray) -> np.ndarray:
    """A human in a pause, twice; what the robot says behind the second one comes 90 samples later."""
    early, late = (
        record(part) for part in (x * (np.arange(x.size) < x.size // 2), x * (np.arange(x.size) >= x.size // 2))
    )
    y = 0.5 * (early + np.roll(late, 90))
    for start in (20_000, 68_000):
        y[start : start + 8000] += 0.02 * np.random.default_rng(8).standard_normal(8000).astype(np.float32)
    return y


@pytest.mark.parametrize("what", ["bent", "elsewhere", "later", "turned_down", "interrupted"])
def test_of_a_comparison(what: str) -> None:
    """What is heard and said before the first and behind the last whole word is cut off from some."""
    x = voice(9.0, seed=4)
    at = np.arange(x.size) % 48_000
    x[(at > 16_000) & (at < 36_000)] = 0.0
    y = interrupted(x) if what == "interrupted" else HAPPENED[what](x)
    if what in ("later", "bent"):
        x = np.where((np.arange(x.size) > 9000) & (np.arange(x.size) < 120_000), x, 0.0).astype(np.float32)
    prepared = prepare(profile(), y, x)
    masks = {"usable": prepared.usable, "active": prepared.active, "fit": prepared.measurement.fit}
    found = compare(profile(), y, x).to_dict()
    turns = {name: np.flatnonzero(np.diff(mask.astype(int))) for name, mask in masks.items()}
    same_as_before(f"comparison_{what}", {**found, **turns, "prediction": levels_db(prepared.prediction)})


def test_of_sounds_that_are_played() -> None:
    """Their level in steps of 50 ms, and that of their differences, which tells the spectrum."""
    sounds = menu(voice(6.0))
    found = {what: [levels_db(part, 0.05) for part in (x, np.diff(x))] for what, x in sounds.items()}
    same_as_before("sounds", found)
