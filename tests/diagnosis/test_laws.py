"""What no listed effect explains: the family whose free law does, with held-out error, in words, and as an effect of the user's own."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage, signal

from edgefilter import add, compare, load_effect
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.diagnosis.laws import Law, free_law
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.score import Scorer
from edgefilter.diagnosis.trials import Found
from edgefilter.echo.effects import catalogue
from edgefilter.echo.running import stream_form
from edgefilter.types import SAMPLE_RATE
from tests.diagnosis.robot_scene import profile, record, voice

X = voice(6.0)
LEVEL = np.sqrt(signal.lfilter([0.005], [1.0, -0.995], X**2) + 1e-9)
"""Of the voice, smoothed over 12 ms."""
HIDDEN = {
    "static nonlinearity": np.maximum(X, 0.25 * X),  # half of each wave
    "dynamics": X * np.clip((LEVEL / 0.1) ** 0.8, 0.0, 1.0),  # an expander: 8 dB per 10 dB below -20 dBFS
    "modulation": X * (1.0 + 0.5 * np.sin(2 * np.pi * 5.0 * np.arange(X.size) / SAMPLE_RATE)),
    "time": ndimage.map_coordinates(  # a clock that is pulled to and fro, 1.5 samples in 5 s
        X, [np.arange(X.size) - 1.5 * np.sin(2 * np.pi * 0.2 * np.arange(X.size) / SAMPLE_RATE)], order=5
    ),
    "linear path": signal.lfilter([1.0] + 60 * [0.0] + [0.7], [1.0], X),
}


@functools.cache
def lawful(family: str) -> Law:
    """The law that is found where nothing was named."""
    prepared = prepare(profile(), record(HIDDEN[family].astype(np.float32)), X)
    score = Scorer(prepared).of(prepared.model)
    law = free_law(Found(prepared, prepared.model, prepared.model, score, score, ()), Criteria())
    assert law is not None and law.family == family and law.excess_db < 0.4 * score.excess_db
    assert law.curve.share == 1.0 or law.curve.y_unit != "dB"  # a gain that is the law's own
    return law


@pytest.fixture
def load(tmp_path: Path, own_catalogue) -> Callable[[Law, str], str]:
    """Write a law and load it, in a catalogue that is as before when the test is over."""

    def loaded(law: Law, name: str) -> str:
        path = tmp_path / f"{name}.py"
        path.write_text(law.file(name), encoding="utf-8")
        assert len(path.read_text().splitlines()) < 60
        return load_effect(path)

    return loaded


@pytest.mark.slow
@pytest.mark.parametrize("family", HIDDEN)
def test_add_takes_the_law_that_is_written_and_the_error_falls(family: str, load) -> None:
    y, law = record(HIDDEN[family].astype(np.float32)), lawful(family)
    name = load(law, f"my_{family.split()[0]}")
    knowing, before, after = add(profile(), name, y, X)
    assert dict(knowing.echo.effects)[name]["amount"] == pytest.approx(1.0, abs=0.1)
    assert after.excess_db < 0.4 * before.excess_db
    assert compare(knowing, y, X).excess_db == pytest.approx(
        after.excess_db, abs=0.3
    )  # with the volume that add takes out


def test_the_running_filter_uses_it_hop_by_hop_as_on_the_whole(load) -> None:
    effect = catalogue.find(load(lawful("dynamics"), "my_expander"))
    make, x = stream_form(effect, {"amount": 1.0}), X[: 4 * SAMPLE_RATE]
    run = make()
    hops = np.concatenate([run(x[at : at + 256]) for at in range(0, x.size, 256)])
    np.testing.assert_allclose(hops, effect.apply(x, {"amount": 1.0}, SAMPLE_RATE), atol=1e-6)


def test_the_law_is_said_in_words() -> None:
    assert "rises" in lawful("dynamics").words and "dB per 10 dB of level" in lawful("dynamics").words
    assert "5 times a second" in lawful("modulation").words


@pytest.mark.slow
def test_what_is_explained_gets_no_law_and_what_is_not_one_beside_what_is_named() -> None:
    turned = diagnose(profile(), record(np.float32(0.7) * X), X)
    assert turned.verdict == "missing" and turned.law is None and turned.to_dict()["law"] is None
    shaken = diagnose(profile(), record(HIDDEN["modulation"].astype(np.float32)), X)
    assert shaken.verdict == "unexplained" and shaken.law is not None
    assert shaken.law.excess_db < 0.5 * shaken.remaining_db and shaken.law.beside == ()
    told = shaken.to_dict()
    assert told["law"]["family"] == "modulation"
    assert told["law"]["gain_db"] == round(shaken.law.gain_db, 3)
    assert told["law"]["excess_db"] == round(shaken.law.excess_db, 3)


def test_where_no_voice_is_there_to_fit_to_there_is_no_law() -> None:
    prepared = prepare(profile(), record(HIDDEN["dynamics"].astype(np.float32)), X)
    mute = replace(prepared, measurement=replace(prepared.measurement, fit=np.zeros(X.size, bool)))
    score = Scorer(mute).of(mute.model)
    assert free_law(Found(mute, mute.model, mute.model, score, score, ()), Criteria()) is None
