"""What no effect explains is not a dead end: the gain that is missing leaps out of one of the curves."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.diagnosis.closer_look import Curve, look_closer
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.score import Scorer
from edgefilter.diagnosis.trials import Found
from edgefilter.types import SAMPLE_RATE
from tests.diagnosis.robot_scene import profile, record, voice

SECONDS = 8.0


def looked(recording: np.ndarray, reference: np.ndarray) -> tuple[str, dict]:
    """The sentence, and the curves by name, where nothing was found."""
    prepared = prepare(profile(), recording, reference)
    score = Scorer(prepared).of(prepared.model)
    look = look_closer(Found(prepared, prepared.model, prepared.model, score, score, ()))
    return look.sentence, {curve.name.split()[0]: curve for curve in look.curves}


def test_a_tremolo_leaps_out_at_its_rate() -> None:
    x = voice(SECONDS)
    gain = 1.0 + 0.5 * np.sin(2 * np.pi * 5.0 * np.arange(x.size) / SAMPLE_RATE)
    sentence, curves = looked(record((gain * x).astype(np.float32)), x)
    rate = curves["rate"]
    assert "comes and goes 5 times a second" in sentence and rate.share > 0.3
    assert rate.x[int(np.argmax(rate.y_db))] == pytest.approx(5.0, abs=0.3)


def test_a_gain_by_level_and_one_by_frequency_are_pointed_at() -> None:
    x = voice(SECONDS)
    level = np.sqrt(np.convolve(x**2, np.ones(320) / 320, "same") + 1e-8)
    _, curves = looked(record((x * np.clip(0.05 / level, 0.2, 1.0)).astype(np.float32)), x)
    by_level = curves["level"]
    assert by_level.y_db[-1] < by_level.y_db[0] - 3.0
    dull = np.convolve(x, [0.5, 0.5])[: x.size].astype(np.float32)
    sentence, curves = looked(record(dull), x)
    assert "by frequency" in sentence and curves["frequency"].y_db[-1] < curves["frequency"].y_db[0] - 3.0


def test_another_sound_in_the_silences_is_pointed_at_and_noise_is_no_gain() -> None:
    x, rng = np.insert(voice(SECONDS), 4 * SAMPLE_RATE, np.zeros(3 * SAMPLE_RATE, np.float32)), np.random.default_rng(4)
    hiss = 0.01 * np.diff(rng.standard_normal(x.size + 1))
    sentence, curves = looked((record(x) + hiss).astype(np.float32), x)
    assert "silences" in sentence and max(curves["frequency,"].y_db) > 3.0
    assert all(curve.share < 0.1 for curve in curves.values())


def test_a_curve_is_written_with_as_many_digits_as_mean_something():
    curve = Curve.of("gain by level", "dB", np.array([1 / 3]), np.array([2 / 3]), 1 / 7)
    assert curve.to_dict() == {
        **{"name": "gain by level", "x_unit": "dB", "x": [0.333], "y_db": [0.67], "share": 0.1429, "y_unit": "dB"}
    }
    assert [Curve.of("", "", np.zeros(1), np.zeros(1), share).share for share in (-0.1, 1.1)] == [0.0, 1.0]
