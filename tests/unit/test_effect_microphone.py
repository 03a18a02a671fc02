"""Effects at the microphone: clipping."""

import numpy as np
import pytest
from conformance import robot_alone

from edgefilter.echo import effect as effects


def test_a_hard_clip_is_found_at_its_level():
    measurement, model = robot_alone()
    clipped = np.clip(measurement.recording, -0.2, 0.2)
    found = effects.find("mic_clipping").fit(type(measurement)(measurement.reference, clipped, measurement.noise_psd, measurement.fit), model)
    assert found["level"] == pytest.approx(0.2, rel=0.01) and found["hardness"] == 100.0


def test_a_soft_limiter_is_found_soft():
    found = effects.find("mic_clipping").fit(*robot_alone("mic_clipping", {"level": 0.2, "hardness": 3.0}))
    assert found["hardness"] < 10.0 and found["level"] == pytest.approx(0.2, rel=0.15)


def test_soft_limiter_never_exceeds_its_level_and_keeps_small_values():
    clip = effects.find("mic_clipping")
    x = np.linspace(-5, 5, 1001, dtype=np.float32)
    out = clip.apply(x, {"level": 0.5, "hardness": 4.0}, 16_000)
    assert np.abs(out).max() <= 0.5 and np.all(np.diff(out) >= 0)
    small = np.abs(x) < 0.1
    np.testing.assert_allclose(out[small], x[small], rtol=1e-3)  # (0.1 / 0.5)^4 / 4


def test_a_loud_recording_below_any_limit_is_left_alone():
    measurement, model = robot_alone("playback_gain", {"gain_db": 3.0})
    found = effects.find("mic_clipping").fit(measurement, model)
    predicted = model.predict(measurement.reference)
    # a faint cubic distortion, which every loudspeaker has, may look like the beginning of a limiter
    assert np.abs(effects.find("mic_clipping").apply(predicted, found, 16_000) - predicted).max() < 0.05 * np.abs(predicted).max()
