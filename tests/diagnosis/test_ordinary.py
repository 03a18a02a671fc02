"""By chance: what is held against ordinary recordings, and what their table says."""

import numpy as np
import pytest
from scipy.stats import kstest

from bench.diagnosis.ordinary import learnt, least
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import LEAST_DB, Chance, Ordinary, explained_db, p_value, percent
from edgefilter.diagnosis.recording import diagnose
from edgefilter.echo.effects.catalogue import names
from edgefilter.echo.model import EchoModel
from tests.diagnosis.robot_scene import path, profile, record, voice

ODD = {"early": 0.0, "rare": 0.9, "never": 1.0}
"""Share of recordings in which the fit of each finds nothing."""


def ordinary(count: int, seed: int) -> list[dict[str, float]]:
    """Gains of recordings in which nothing is missing; two of the effects always find the same."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        power_db = {name: rng.normal(-20.0, 4.0) if rng.random() >= none else LEAST_DB for name, none in ODD.items()}
        gains = {
            name: float(10 * np.log10(1 + 10 ** (db / 10))) if db > LEAST_DB else 0.0 for name, db in power_db.items()
        }
        found.append({**gains, "twin": gains["early"]})
    return found


def table(found: list[dict[str, float]]) -> Ordinary:
    learned = learnt(found)
    return Ordinary({name: Chance(**of) for name, of in learned["effects"].items()}, learned["independent"])


def test_what_is_explained_is_a_power_and_nothing_where_the_level_does_not_fall():
    assert explained_db(10 * np.log10(2.0)) == pytest.approx(0.0)
    assert explained_db(10 * np.log10(1.001)) == pytest.approx(-30.0, abs=0.01)
    assert explained_db(0.0) == explained_db(-3.0) == LEAST_DB


def test_p_values_are_uniform_on_recordings_that_the_table_has_not_seen():
    p = least(table(ordinary(2000, 1)).p_value, ordinary(2000, 2))
    assert kstest(p, "uniform").statistic < 0.08
    assert np.mean(p < 0.01) == pytest.approx(0.01, abs=0.007)
    wrong = least(table([{n: g / 4 for n, g in one.items()} for one in ordinary(2000, 1)]).p_value, ordinary(2000, 2))
    assert np.mean(wrong < 0.01) > 0.05  # a table of quieter robots than those at hand


def test_the_more_is_explained_the_less_it_is_chance_and_a_rare_fit_needs_less():
    chances = table(ordinary(2000, 1))
    by_gain = [chances.p_value("early", gain_db) for gain_db in (-1.0, 0.0, 0.01, 0.1, 1.0)]
    assert by_gain[:2] == [1.0, 1.0] and by_gain[1:] == sorted(by_gain[1:], reverse=True) and by_gain[-1] < 1e-3
    assert chances.p_value("never", 0.1) < chances.p_value("rare", 0.1) < chances.p_value("early", 0.1)


def test_an_effect_that_is_not_in_the_table_is_held_against_the_one_that_explains_most():
    chances = table(ordinary(2000, 1))
    known = max(chances.p_value(name, 0.2) for name in chances.effects)
    assert chances.p_value("my_own", 0.2) == known > 0.0


def test_the_table_that_comes_along_knows_every_effect_and_the_default_rate_lets_clear_ones_through():
    for name in names():
        assert p_value(name, 0.0) == 1.0 and p_value(name, 3.0) <= Criteria.false_rate
        assert p_value(name, 1e-4) > Criteria.false_rate


def test_people_read_percent():
    assert [percent(p) for p in (1e-9, 2e-4, 0.0123, 0.4, 1.0)] == [
        "less than 0.01 %",
        "0.02 %",
        "1.2 %",
        "40 %",
        "100 %",
    ]


@pytest.mark.slow
def test_the_user_says_how_often_a_name_may_be_chance():
    """A volume turned by a third of a decibel: named at one false name in a hundred or so, not at one in a million."""
    x = voice(6.0)
    heard = record(x, EchoModel(path()).with_effect("playback_gain", {"gain_db": -0.35}))
    usual, strict = (diagnose(profile(), heard, x, criteria=Criteria(false_rate=rate)) for rate in (0.05, 1e-6))
    (finding,) = usual.ranking
    assert (finding.effect, finding.family) == ("playback_gain", "linear path") and 1e-6 < finding.p_value < 0.05
    assert not strict.ranking
    why = {one.effect: one.why for one in strict.tried}["playback_gain"]
    assert why == "what is left is too little for it to be named"
