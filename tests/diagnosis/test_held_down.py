"""Voices held down by devices of another make are called what the device is: limiter, compressor, multi-band compressor."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.trials import Workbench
from tests.diagnosis.robot_scene import feedback, profile, record, voice

RATE = 16000
RIVALS = ("playback_gain", "compression", "limiter", "multiband_compression", "equaliser", "early_path")


def looking_ahead(x: np.ndarray) -> np.ndarray:
    """A limiter that knows the next 2 ms, and holds and smooths its gain."""
    ceiling = 0.45 * np.abs(x).max()
    needed = np.minimum(1.0, ceiling / np.maximum(maximum_filter1d(np.abs(x), 480), ceiling / 10))
    return x * uniform_filter1d(needed, 160)


def in_bands(x: np.ndarray) -> np.ndarray:
    """Three of those, at crossovers of Linkwitz and Riley."""

    def cut(y: np.ndarray, hz: float) -> list[np.ndarray]:
        sections = (signal.butter(2, hz, kind, fs=RATE, output="sos") for kind in ("low", "high"))
        return [signal.sosfilt(sos, signal.sosfilt(sos, y)) for sos in sections]

    low, rest = cut(x, 400.0)
    middle, high = cut(rest, 2200.0)
    return 1.5 * feedback(low, 2.0, -35.0) + 1.8 * feedback(middle, 3.0, -45.0) + 2.2 * feedback(high, 2.5, -50.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("device", "expected"),
    [
        (looking_ahead, "limiter"),
        (lambda x: 2.0 * feedback(x, 3.0, -35.0), "compression"),
        (in_bands, "multiband_compression"),
    ],
)
def test_what_holds_the_voice_down_is_told_from_its_rivals(device, expected: str) -> None:
    x = voice(8.0)
    prepared = prepare(profile(), record(device(x.astype(float)).astype(np.float32)), x)
    bench = Workbench(prepared, Criteria())
    trials = [trial for name in RIVALS if (trial := bench.attempt(name, prepared.model)) is not None]
    chosen = bench.preferred(trial for trial in trials if bench.admissible(trial))
    assert chosen is not None and chosen.name == expected, [(t.name, round(t.gain_db, 2)) for t in trials]
