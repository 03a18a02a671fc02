"""A suppressor behind the microphone is named; a softer fan, a gain turned down and a clock beside it are not called one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.recording import add, diagnose
from edgefilter.diagnosis.select import search
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel
from edgefilter.echo.running import reach
from tests.diagnosis.robot_scene import FAN, path, profile, record, voice

SECONDS = 8.0
FRAME, STEP = 320, 160


def suppressed(y: np.ndarray, depth_db: float) -> np.ndarray:
    """Wiener's gain by the decision-directed ratio (Ephraim & Malah 1984) in frames of 20 ms, no less than depth_db."""
    window = np.sqrt(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(FRAME) / FRAME))
    noise, floor = FAN**2 * np.sum(window**2), 10 ** (depth_db / 20)
    out, kept = np.zeros(y.size), np.zeros(FRAME // 2 + 1)
    for at in range(0, y.size - FRAME, STEP):
        spectrum = np.fft.rfft(window * y[at : at + FRAME])
        ratio = np.abs(spectrum) ** 2 / noise
        prior = 0.9 * kept + 0.1 * np.maximum(ratio - 1.0, 0.0)
        gain = np.maximum(prior / (1.0 + prior), floor)
        kept = gain**2 * ratio
        out[at : at + FRAME] += window * np.fft.irfft(gain * spectrum)
    return out.astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("depth_db", [-5.0, -12.0, -30.0])
def test_a_suppressor_is_named_however_deep_it_is(depth_db: float) -> None:
    x = voice(SECONDS)
    found = diagnose(profile(), suppressed(record(x), depth_db), x)
    assert [finding.effect for finding in found.ranking] == ["noise_suppression"], found.evidence
    softer = found.ranking[0].parameters["softer_db"].value
    # a decision-directed gain lets some of the noise through above its floor
    assert depth_db - 1.0 < softer < -2.0
    assert "softer than calibrated" in found.ranking[0].evidence


@pytest.mark.slow
def test_it_is_named_beside_what_the_loudspeaker_does() -> None:
    x = voice(SECONDS)
    found = diagnose(profile(), suppressed(0.8 * record(x) + 0.2 * record(0.0 * x), -12.0), x)
    assert {finding.effect for finding in found.ranking} == {"noise_suppression", "playback_gain"}


def _softer(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda x: record(x) - (1.0 - factor) * record(0.0 * x)


@pytest.mark.parametrize(
    ("change", "silence_db"),
    [
        (record, 0.0),
        (_softer(0.3), -10.5),
        (lambda x: 0.4 * record(x), -8.0),
        (
            lambda x: _softer(0.3)(np.interp(np.arange(x.size) * (1 + 3e-4), np.arange(x.size), x).astype(np.float32)),
            -10.5,
        ),
        (lambda x: record(x, EchoModel(path(seed=5))) - 0.7 * record(0.0 * x), -10.5),
    ],
    ids=["nothing", "a softer fan", "a gain turned down", "a softer fan, a clock", "a softer fan, another room"],
)
def test_what_is_soft_without_a_suppressor_is_not_called_one(change, silence_db: float) -> None:
    x = voice(SECONDS)
    prepared = prepare(profile(), change(x), x)
    base = prepared.of(prepared.model)
    assert base.silent_db == pytest.approx(silence_db, abs=0.7)
    assert "noise_suppression" not in [step.name for step in search(prepared, prepared.model, Criteria()).steps]


@pytest.mark.slow
def test_a_suppressor_that_lets_weak_voice_through_less_is_seen_in_the_numbers() -> None:
    x = voice(SECONDS)
    better, before, after = add(profile(), "noise_suppression", suppressed(record(x), -12.0), x)
    values = dict(better.echo.effects)["noise_suppression"]
    # the first gain is that of the few cells in which the voice can just be told from the fan
    assert np.all(np.diff(values["gain_db"])[1:] > 0.0) and values["gain_db"][0] < -5.0 and values["gain_db"][-1] > -0.5
    assert after.excess_db < before.excess_db - 0.3
    assert "changes nothing" in reach(find("noise_suppression"), values)


def test_what_the_running_filter_contradicts_is_not_looked_for() -> None:
    x = voice(SECONDS)
    prepared = prepare(profile(), suppressed(record(x), -12.0), x)
    named, others = (
        [step.name for step in search(prepared, prepared.model, Criteria(), without=without).steps]
        for without in ((), ("noise_suppression",))
    )
    assert named == ["noise_suppression"] and "noise_suppression" not in others


@pytest.mark.slow
def test_it_stays_named_beside_what_nothing_explains() -> None:
    x = voice(SECONDS)
    trembling = 0.7 + 0.3 * np.sin(2 * np.pi * 7.0 * np.arange(x.size) / 16000)
    quick = Criteria(most_effects=2)
    found = diagnose(profile(), suppressed(record((trembling * x).astype(np.float32)), -12.0), x, criteria=quick)
    assert found.verdict == "unexplained" and [f.effect for f in found.ranking][:1] == ["noise_suppression"]
    row = next(row for row in found.tried if row.effect == "noise_suppression")
    assert row.verdict == "named"
