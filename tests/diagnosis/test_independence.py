"""The tests of a residual: what is independent stays within the bounds, what is not is found at its lag, on its side."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from edgefilter.diagnosis.independence import (
    CROSS_MS,
    Correlogram,
    Independence,
    Zone,
    independence,
    lagged_sums,
    whitener,
)
from edgefilter.dsp.psd import frequencies
from edgefilter.types import PRE_ROLL
from tests.diagnosis.robot_scene import voice

RATE, BINS = 16000, 601
N = 12 * RATE
COLOUR = np.array([1.0, -0.8])


def fan(seed: int = 5) -> np.ndarray:
    return 1e-3 * signal.lfilter([1.0], COLOUR, np.random.default_rng(seed).standard_normal(N)).astype(np.float32)


def psd() -> np.ndarray:
    """(601,) of fan(), exactly."""
    spectrum = signal.freqz([1.0], COLOUR, frequencies(BINS), fs=RATE)[1]
    return (1e-6 * np.abs(spectrum) ** 2 / (RATE / 2)).astype(np.float32)


@pytest.fixture(scope="module")
def said() -> np.ndarray:
    return voice(N / RATE, seed=2)


def independence_of(residual: np.ndarray, said: np.ndarray, silences: bool = True):
    talks = np.arange(N) % (2 * RATE) < 1.5 * RATE
    return independence(residual, said, psd(), talks, ~talks if silences else np.zeros(N, bool))


def test_sums_over_lags_are_those_of_the_definition():
    a, b = np.random.default_rng(0).standard_normal((2, 7000))
    for low, high in ((1, 40), (-30, 50), (-50, -10), (-3000, 2500)):
        slow = [
            sum(a[n] * b[n - lag] for n in range(max(lag, 0), 7000 + min(lag, 0))) for lag in (low, low + 3, high - 1)
        ]
        fast = lagged_sums(a, b, low, high)
        assert fast.size == high - low and fast[[0, 3, -1]] == pytest.approx(slow, abs=1e-9)


def test_the_fan_made_white_is_white_of_variance_one():
    white = np.convolve(fan(), whitener(psd()))[:N]
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.02)  # 192 000 samples: 0.003 by chance
    assert abs(np.mean(white[1:] * white[:-1])) < 0.01  # its own 99 % bound is 0.006


@pytest.mark.parametrize("silences", [True, False])
def test_what_is_independent_is_called_so_and_one_lag_in_a_hundred_is_outside(said, silences):
    found = independence_of(fan(), said, silences)
    assert not found.autocorrelation.dependent and not any(zone.part.dependent for zone in found.zones)
    assert found.cross_correlation.values.size == 16 * (CROSS_MS[1] - CROSS_MS[0])
    assert 0.002 < found.cross_correlation.outside < 0.02  # 0.01 of 2000 lags, neighbours not quite independent
    assert found.autocorrelation.outside < 0.03  # 0.01 of 400
    assert all(zone.share < 0.01 for zone in found.zones)


@pytest.mark.parametrize(("lag_ms", "side"), [(-10.0, 0), (0.0, 1), (20.0, 2), (70.0, 2)])
def test_a_dependence_is_found_at_its_lag_and_on_its_side_alone(said, lag_ms, side):
    late = PRE_ROLL + round(16 * lag_ms)
    found = independence_of(fan() + 0.05 * np.roll(said, late), said)
    zones = found.zones
    assert [zone.part.dependent for zone in zones] == [at == side for at in range(3)]
    assert zones[side].part.summary()["largest_at_ms"] == pytest.approx(lag_ms, abs=1 / 16)
    loud = 0.0025 * np.mean(signal.lfilter(whitener(psd()), 1.0, said) ** 2)
    talking = np.arange(N) % (2 * RATE) < 1.5 * RATE
    expected = loud / (loud + np.mean(talking))
    assert zones[side].share == pytest.approx(expected, abs=0.15)  # a ridge takes some of a coloured voice's top octave
    assert found.autocorrelation.dependent


def test_too_little_voice_gives_no_answer(said):
    nowhere = np.zeros(N, bool)
    assert independence(fan(), said, psd(), nowhere, ~nowhere) is None


def test_figures_are_written_with_as_many_digits_as_mean_something():
    at = np.array([0.0, 1 / 3, 2 / 3])
    part = Correlogram(at, np.array([0.1, -2 / 3, 0.0]), np.zeros(3), np.full(3, 1 / 7))
    summary = {"outside": 0.3333, "dependent": True, "largest": -0.66667, "largest_at_ms": 0.3333}
    arrays = {"lags_ms": [0.0, 0.33333, 0.66667], "values": [0.1, -0.66667, 0.0]}
    whole = {**arrays, "expected": [0.0] * 3, "bounds": [0.14286] * 3, **summary}
    assert part.to_dict() == whole
    zone = Zone(1.0, 2.0, "early", 1 / 7, part)
    told = {"low_ms": 1.0, "high_ms": 2.0, "meaning": "early", "share": 0.1429, **summary}
    assert Independence(part, part, (zone,), 2 / 3).to_dict() == {
        **{"seconds": 0.667, "autocorrelation": whole, "cross_correlation": whole, "zones": [told]}
    }
