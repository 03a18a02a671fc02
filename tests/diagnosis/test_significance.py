"""The probability of chance: uniform where an effect is absent, small where it is there; the rate of false names is what was asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.score import Judge
from edgefilter.diagnosis.significance import discovered, p_value
from edgefilter.echo.model import EchoModel
from tests.diagnosis.robot_scene import path, profile, record, voice


@pytest.fixture(scope="module")
def judged() -> tuple[Judge, object]:
    x = voice(6.0)
    prepared = prepare(profile(), record(x, EchoModel(path()).with_effect("playback_gain", {"gain_db": -3.0})), x)
    judge = Judge(prepared)
    return judge, judge.of(prepared.model)


def test_changes_that_are_not_in_the_recording_get_uniform_probabilities(judged) -> None:
    """300 changes, each as loud as the voice where that is: what is left without them is a turned voice and the fan."""
    judge, before = judged
    rng, found = np.random.default_rng(1), []
    for _ in range(300):
        change = np.abs(before.prediction) * rng.standard_normal(before.prediction.size).astype(np.float32)
        found.append(p_value(judge, before, replace(before, prediction=before.prediction + change)))
    assert stats.kstest(found, "uniform").pvalue > 0.01
    assert np.mean(np.array(found) < 0.05) < 0.09  # three standard errors of 0.05


def test_a_change_that_is_in_the_recording_is_hardly_chance(judged) -> None:
    judge, before = judged
    louder, softer = (replace(before, prediction=np.float32(gain) * before.prediction) for gain in (1.2, 0.8))
    assert p_value(judge, before, softer) < 1e-6 and p_value(judge, before, louder) > 1.0 - 1e-6
    assert p_value(judge, before, before) == 1.0


def test_noise_that_is_there_is_hardly_chance_and_noise_that_is_not_is(judged) -> None:
    judge, before = judged
    assert p_value(judge, before, replace(before, deviance=before.deviance - 0.1)) < 1e-6
    assert p_value(judge, before, replace(before, deviance=before.deviance + 0.1)) > 1.0 - 1e-6


def test_of_all_names_at_most_the_rate_is_false() -> None:
    """Where nothing is there something is discovered as often as the rate says; a strong one does not let weak ones pass alone."""
    rng, rate = np.random.default_rng(3), 0.1
    some = [bool(discovered({str(i): p for i, p in enumerate(rng.uniform(size=20))}, 20, rate)) for _ in range(2000)]
    assert np.mean(some) == pytest.approx(rate, abs=0.03)
    assert discovered({"a": 1e-9, "b": 0.02, "c": 0.6}, 20, 0.01) == {"a"}
    assert discovered({}, 20, 0.01) == set()


def test_what_may_be_chance_is_not_named_at_a_rate_that_forbids_it() -> None:
    x = voice(6.0)
    y = record(x, EchoModel(path()).with_effect("playback_gain", {"gain_db": -3.0}))
    (finding,) = diagnose(profile(), y, x).ranking
    assert finding.effect == "playback_gain" and finding.p_value < 1e-6
    none = diagnose(profile(), y, x, criteria=Criteria(false_rate=1e-300))
    assert none.ranking == () and none.verdict == "unexplained" and none.remaining_db == none.comparison.excess_db


def test_another_fan_that_is_named_is_likelier_than_the_calibrated_one() -> None:
    """It had a worse criterion than anything else: its gain was that of the power over a fan that is another by then."""
    x = np.insert(voice(6.0), 3 * 16_000, np.zeros(32_000, np.float32))
    hiss = 0.004 * np.diff(np.random.default_rng(4).standard_normal(x.size + 1))
    found = diagnose(profile(), (record(x) + hiss).astype(np.float32), x)
    assert [finding.effect for finding in found.ranking] == ["fan_noise"]
    (row,) = (row for row in found.tried if row.effect == "fan_noise")
    assert row.delta_bic < -100 and found.ranking[0].p_value < 1e-6
