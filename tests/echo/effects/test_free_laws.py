"""Families whose law is free: laws that no listed effect has are found, and said by their shape."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.dynamics import Setting, smoothed
from edgefilter.types import SAMPLE_RATE
from tests.conformance import EFFECT_CASES, fan, held_out_power, robot_alone, robot_model, robot_speech


def explained(name: str, sent: np.ndarray) -> tuple[float, float, dict]:
    """Residual power over the fan on held-out samples, before and after the effect is fitted to a robot that plays sent, and its values."""
    measurement, model = robot_alone()
    recording = (robot_model().predict(sent.astype(np.float32)) + fan(sent.size)).astype(np.float32)
    measurement = type(measurement)(robot_speech(), recording, measurement.noise_psd, measurement.fit)
    fitted = model.fit(name, measurement)
    before, after = (held_out_power(measurement, each.predict(robot_speech())) for each in (model, fitted))
    return before, after, dict(dict(fitted.effects)[name])


@pytest.mark.parametrize(
    "law",
    [
        lambda x: (np.tanh(3.0 * x + 0.6) - np.tanh(0.6)) / 3.0,
        lambda x: np.maximum(x, 0.0),
        lambda x: x / (1.0 + np.abs(3.0 * x)),
    ],
    ids=["a valve with an offset", "a rectifier", "a sigmoid"],
)
def test_a_static_law_that_nobody_listed_is_found(law: object) -> None:
    before, after, values = explained("static_curve", law(robot_speech().astype(float)))
    assert before > 20.0 and after - 1.0 < 0.05 * (before - 1.0)
    assert "one curve" in find("static_curve").sentence(values)


def test_an_expander_with_its_own_times_is_found() -> None:
    """Soft passages are turned down: no listed effect does so. The level is smoothed sample by sample here, by steps in the fit."""
    x = robot_speech().astype(float)
    level, now = np.empty(x.size), 0.0
    for i, size in enumerate(np.abs(x)):
        now += (size - now) * (1.0 / 80.0 if size > now else 1.0 / 3200.0)
        level[i] = now
    gain = np.clip(level / 0.3, 0.2, 1.0) ** 1.5
    before, after, values = explained("dynamics", gain * x)
    assert before > 3.0 and after - 1.0 < 0.1 * (before - 1.0)
    assert "the gain rises by up to" in find("dynamics").sentence(values)


def test_a_tremolo_is_told_by_its_rate() -> None:
    """Made ahead of the room, whose reflections carry the gain of some moments before: a part of it is left."""
    t = np.arange(robot_speech().size) / SAMPLE_RATE
    before, after, values = explained("modulation", robot_speech() * (0.7 + 0.3 * np.sin(2 * np.pi * 5.3 * t)))
    assert before > 5.0 and after - 1.0 < 0.15 * (before - 1.0)
    assert values["rate_hz"] == pytest.approx(5.3, abs=0.02)
    assert "5.3" in find("modulation").sentence(values)


def test_levels_of_one_setting_are_those_of_many_at_once() -> None:
    settings = [Setting(0.0, 3.0, 80.0, -40.0), Setting(1.0, 10.0, 200.0, -200.0), Setting(2.0, 1.0, 30.0, -200.0)]
    start = np.array([s.rest for s in settings])
    together, _ = smoothed(robot_speech(), settings, start)
    for i, setting in enumerate(settings):
        alone, _ = smoothed(robot_speech(), [setting], start[i : i + 1])
        np.testing.assert_allclose(together[i], alone[0], atol=1e-9)


def test_a_level_without_sound_stays_at_rest() -> None:
    level, _ = smoothed(np.zeros(1600, np.float32), [Setting(0.0, 3.0, 80.0, -40.0)], np.array([-40.0]))
    assert np.all(level == -40.0)


LAWS = [
    ("static_curve", EFFECT_CASES["static_curve"]),
    ("modulation", EFFECT_CASES["modulation"]),
    ("dynamics", EFFECT_CASES["dynamics"]),
    ("dynamics", {**EFFECT_CASES["dynamics"], "exponent": 0.0, "floor_db": -40.0, "ahead_ms": 3.0}),
    (
        "dynamics",
        {
            **EFFECT_CASES["dynamics"],
            "crossover_hz": np.array([400.0, 2500.0]),
            "gain_db": np.linspace(3.0, -9.0, 21),
            "attack_ms": np.array([3.0, 5.0, 8.0]),
            "delay": -12.0,
        },
    ),
]


@pytest.mark.parametrize(("name", "values"), LAWS, ids=["curve", "by time", "by level", "looking ahead", "three bands"])
def test_the_law_as_python_is_the_effect(name: str, values: dict) -> None:
    """But for the first milliseconds, in which the written law holds the first gain."""
    x, effect = robot_speech()[:32_000], find(name)
    scope: dict = {"np": np, "signal": signal}
    exec(effect.code(complete(effect, values)), scope)
    expected, found = effect.apply(x, complete(effect, values), SAMPLE_RATE)[800:-800], scope["law"](x, SAMPLE_RATE)
    assert np.mean((found[800:-800] - expected) ** 2) < 1e-4 * np.mean(expected.astype(float) ** 2)
