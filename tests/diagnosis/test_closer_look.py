"""What no effect explains is not a dead end: of the laws of all families the one that explains most is drawn and pointed at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edgefilter.diagnosis.closer_look import Curve, look_closer
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.laws import with_laws
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.trials import Found
from edgefilter.types import SAMPLE_RATE
from tests.diagnosis.robot_scene import profile, record, voice

SECONDS = 4.0


def looked(recording: np.ndarray, reference: np.ndarray) -> tuple[str, tuple[Curve, ...]]:
    """The sentence and the curves, where nothing was found and no law explains enough to be accepted."""
    prepared = prepare(profile(), recording, reference)
    score = prepared.of(prepared.model)
    found = Found(prepared, prepared.model, prepared.model, score, score, ())
    look = look_closer(with_laws(found, replace(Criteria(), part=2.0)))
    return look.sentence, look.curves


def test_a_tremolo_leaps_out_at_its_rate() -> None:
    x = voice(SECONDS)
    gain = 1.0 + 0.5 * np.sin(2 * np.pi * 5.0 * np.arange(x.size) / SAMPLE_RATE)
    sentence, (first, *_) = looked(record((gain * x).astype(np.float32)), x)
    assert sentence.startswith("a gain that comes and goes would explain ") and "5 times a second" in sentence
    assert first.name == "time in a period" and first.share > 0.3 and first.x[-1] == pytest.approx(0.2, abs=0.01)


def test_another_sound_in_the_silences_is_pointed_at_and_noise_is_no_gain() -> None:
    x, rng = np.insert(voice(SECONDS), 2 * SAMPLE_RATE, np.zeros(3 * SAMPLE_RATE, np.float32)), np.random.default_rng(4)
    hiss = 0.01 * np.diff(rng.standard_normal(x.size + 1))
    sentence, curves = looked((record(x) + hiss).astype(np.float32), x)
    assert "silences" in sentence and max(curves[-1].y_db) > 3.0
    assert all(curve.share < 0.1 for curve in curves)


def test_a_curve_is_written_with_as_many_digits_as_mean_something():
    curve = Curve.of("gain by level", "dB", np.array([1 / 3]), np.array([2 / 3]), 1 / 7)
    assert curve.to_dict() == {
        **{"name": "gain by level", "x_unit": "dB", "x": [0.333], "y_db": [0.67], "share": 0.1429, "y_unit": "dB"}
    }
    assert [Curve.of("", "", np.zeros(1), np.zeros(1), share).share for share in (-0.1, 1.1)] == [0.0, 1.0]
