"""What is left in the error, and the mask that takes it out: levels, the human's passage, and the floor."""

import numpy as np
import pytest

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.spectral_subtraction import FLOOR, SpectralSubtraction
from edgefilter.filter.residual_echo import Residual
from edgefilter.types import Frame
from tests.conformance import robot

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
    out = run(errors, NOTHING + 1, NOTHING)
    assert (np.abs(out) / np.abs(errors)).min() == pytest.approx(FLOOR, rel=1e-5)  # float32
    assert db(out[20:]) < db(errors[20:]) - 9  # -15 dB is the floor; random peaks rise above it


def test_no_bin_is_louder_than_in_the_error_whatever_is_expected():
    rng = np.random.default_rng(3)
    levels = 10.0 ** rng.uniform(-12.0, 12.0, (3, 200))
    for expected in (levels, 0 * levels, levels[:, ::-1]):
        errors = np.array([noise(rng, level) for level in levels[0]])
        engine, state = SpectralSubtraction(), SpectralSubtraction().initial_state()
        for error, fan, residual in zip(errors, expected[1], expected[2], strict=True):
            answer, state = engine.step(Frame(error, SILENCE, SILENCE, error, NOTHING + fan, NOTHING + residual), state)
            assert np.all(np.abs(answer.spectrum) <= np.abs(error) * (1.0 + 1e-6))


def test_a_human_20_db_above_what_is_unwanted_passes_within_half_a_decibel():
    rng = np.random.default_rng(1)
    errors = np.array([noise(rng, 101.0) for _ in range(100)])
    for fan, residual in ((NOTHING + 1, NOTHING), (NOTHING, NOTHING + 1)):
        assert db(run(errors, fan, residual)[10:]) > db(errors[10:]) - 0.5


def test_nothing_unwanted_changes_nothing():
    errors = np.array([noise(np.random.default_rng(2), 1e-4) for _ in range(20)])
    # xi is finite: 1e-12 stands beside 1e-4
    np.testing.assert_allclose(run(errors, NOTHING, NOTHING)[1:], errors[1:], rtol=1e-3)


@pytest.mark.parametrize("part", [0.002, 0.03])
def test_the_part_of_the_echo_that_stays_is_tracked_and_a_human_hardly_lifts_it(part):
    residual, rng = Residual(STFT, robot()), np.random.default_rng(5)

    def expected(seconds, human):
        found = []
        for frame in range(int(seconds * 16000 / STFT.hop)):
            speaks = frame % 20 >= 5  # what never pauses would be noise
            echo, error = speaks * noise(rng, 1.0), speaks * noise(rng, part) + noise(rng, human) + noise(rng, 1e-6)
            residual_psd = residual.step(echo, error, NOTHING)[1]
            found += [residual_psd] * speaks
        return np.mean(found[-60:])

    alone = expected(20, 0.0)
    assert part < alone < 8 * part  # MARGIN, and the echo's maximum over frames, which is above its mean
    assert expected(2, 0.5) < 10**0.3 * alone  # 1.4 dB a second
    assert expected(8, 0.0) < 1.2 * alone  # a memory of half a second forgets what was 250 times as much in 3 s


def test_without_a_profile_the_fan_is_learnt_and_speech_does_not_lift_it():
    residual, rng = Residual(STFT), np.random.default_rng(4)
    for _ in range(4000):
        fan, _ = residual.step(SILENCE, noise(rng, 1e-3), NOTHING)
    learnt = np.median(fan)
    assert 0.3e-3 < learnt < 1.5e-3  # a minimum-like follower lies somewhat below the mean
    for frame in range(60):  # one second of speech 20 dB above, in syllables
        fan, _ = residual.step(SILENCE, noise(rng, 1e-1 if frame % 15 < 10 else 1e-3), NOTHING)
    assert np.median(fan) < 2 * learnt
