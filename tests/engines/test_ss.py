"""The mask that takes out what is left in the error: levels, the human's passage, and the floor."""

import numpy as np
import pytest

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.spectral_subtraction import FLOOR, SpectralSubtraction
from edgefilter.types import Frame

STFT = StftConfig()
NOTHING = np.zeros(STFT.bins, np.float32)
SILENCE = np.zeros(STFT.bins, np.complex64)


def noise(rng, power):
    return (np.sqrt(power / 2) * (rng.standard_normal(STFT.bins) + 1j * rng.standard_normal(STFT.bins))).astype(
        np.complex64
    )


def run(errors, fan, residual):
    engine = SpectralSubtraction()
    state, out = engine.initial_state(), []
    for error in errors:
        answer, state = engine.step(Frame(error, SILENCE, SILENCE, error, fan, residual), state)
        out.append(answer.spectrum)
    return np.array(out)


def db(x):
    return 10 * np.log10(np.mean(np.abs(x) ** 2))


def test_fan_alone_falls_towards_the_floor_and_never_below_it():
    rng = np.random.default_rng(0)
    errors = np.array([noise(rng, 1.0) for _ in range(200)])
    gain = np.abs(run(errors, NOTHING + 1, NOTHING)) / np.abs(errors)
    assert gain.min() == pytest.approx(FLOOR, rel=1e-5)  # float32
    assert (
        db(run(errors, NOTHING + 1, NOTHING)[20:]) < db(errors[20:]) - 9
    )  # -15 dB is the floor; random peaks rise above it


def test_a_human_20_db_above_what_is_unwanted_passes_within_half_a_decibel():
    rng = np.random.default_rng(1)
    errors = np.array([noise(rng, 101.0) for _ in range(100)])
    for fan, residual in ((NOTHING + 1, NOTHING), (NOTHING, NOTHING + 1)):
        assert db(run(errors, fan, residual)[10:]) > db(errors[10:]) - 0.5


def test_nothing_unwanted_changes_nothing():
    errors = np.array([noise(np.random.default_rng(2), 1e-4) for _ in range(20)])
    np.testing.assert_allclose(
        run(errors, NOTHING, NOTHING)[1:], errors[1:], rtol=1e-3
    )  # xi is finite: 1e-12 stands beside 1e-4
