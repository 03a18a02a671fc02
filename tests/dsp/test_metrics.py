"""SI-SDR and ERLE against values that follow from their definitions."""

import math

import numpy as np
import pytest

from edgefilter.dsp.metrics import erle, si_sdr
from edgefilter.errors import SignalError


def orthogonal_pair(n: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Two unit-power signals whose inner product is zero to rounding."""
    phase = 2 * np.pi * 10 * np.arange(n) / n
    return np.sqrt(2) * np.sin(phase), np.sqrt(2) * np.cos(phase)


@pytest.mark.parametrize("level_db", [-26.0, -3.0, 0.0, 12.0])
def test_si_sdr_of_orthogonal_noise_is_the_power_ratio(level_db: float) -> None:
    human, noise = orthogonal_pair()
    assert si_sdr(human + 10 ** (-level_db / 20) * noise, human) == pytest.approx(
        level_db, abs=1e-9
    )  # float64 rounding


@pytest.mark.parametrize("gain", [1e-3, -0.5, 40.0])
def test_si_sdr_ignores_scale_of_estimate_and_target(gain: float) -> None:
    human, noise = orthogonal_pair()
    mixture = human + 0.3 * noise + 0.2
    expected = si_sdr(mixture, human)
    assert si_sdr(gain * mixture, human) == pytest.approx(expected, abs=1e-9)  # float64 rounding
    assert si_sdr(mixture, gain * human) == pytest.approx(expected, abs=1e-9)


def test_si_sdr_does_not_remove_the_mean() -> None:
    human, _ = orthogonal_pair()
    assert si_sdr(human + 1.0, human) == pytest.approx(
        0.0, abs=1e-9
    )  # the offset has the human's power; float64 rounding


def test_si_sdr_at_its_ends() -> None:
    human, noise = orthogonal_pair()
    assert si_sdr(human, human) == math.inf
    assert si_sdr(noise, human) < -200  # orthogonal to rounding of 1e-16


def test_si_sdr_of_silence_is_the_worst_value_not_the_best() -> None:
    human, _ = orthogonal_pair()
    assert si_sdr(np.zeros_like(human), human) == -math.inf


def test_erle_is_the_fall_of_power() -> None:
    echo, human = orthogonal_pair()
    assert erle(echo, 0.05 * echo) == pytest.approx(20 * math.log10(20), abs=1e-9)  # float64 rounding
    assert erle(echo, 2.0 * human) == pytest.approx(-20 * math.log10(2), abs=1e-9)
    assert erle(echo, np.zeros_like(echo)) == math.inf


@pytest.mark.parametrize("metric", [si_sdr, erle])
def test_bad_input_is_named(metric) -> None:
    x = np.ones(10, np.float32)
    with pytest.raises(SignalError, match="10 samples and .* 9"):
        metric(x, x[:9])
    with pytest.raises(SignalError, match="nan at sample 0"):
        metric(np.full(10, np.nan), x)
    with pytest.raises(SignalError, match="silent"):
        metric(np.zeros(10, np.float32), np.zeros(10, np.float32))


@pytest.mark.parametrize("metric", [si_sdr, erle])
def test_caller_arrays_may_be_read_only(metric) -> None:
    x = np.linspace(-0.5, 0.5, 100, dtype=np.float32)
    x.flags.writeable = False
    assert metric(x, x) == (math.inf if metric is si_sdr else 0.0)
