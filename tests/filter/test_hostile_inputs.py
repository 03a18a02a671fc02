"""Whatever comes in, no engine is louder than the microphone by more than 1 dB over a second."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from edgefilter import Profile, calibrate, engines, enhance, generate_sweep
from edgefilter.types import PRE_ROLL, SAMPLE_RATE
from tests.alignment.scene import speech_like
from tests.filter.loudness import loudest_over_mic_db

SECONDS = 6
SIZE = SECONDS * SAMPLE_RATE
ENGINES = tuple(name for name in engines.ENGINES if name not in ("paper-crnn", "ss"))
"""All that are shipped, as the network of paper-crnn is not, but ss: it makes no bin louder than linear (test_ss.py)."""


def room(rng: np.random.Generator, taps: int = 4800) -> np.ndarray:
    path = np.zeros(taps + PRE_ROLL, np.float32)
    path[PRE_ROLL:] = rng.standard_normal(taps) * 10.0 ** (-3.0 * np.arange(taps) / 4800) * 0.05
    path[PRE_ROLL] = 0.6
    return path


def heard(ref: np.ndarray, path: np.ndarray, delay: int) -> np.ndarray:
    late = np.concatenate((np.zeros(delay, np.float32), ref))[: ref.size]
    return fftconvolve(late, path)[: ref.size].astype(np.float32)


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Reference, its echo, a human, a fan and the path."""
    rng = np.random.default_rng(seed)
    ref = speech_like(rng, SECONDS)[:SIZE].astype(np.float32)
    human = 0.1 * speech_like(rng, SECONDS)[:SIZE].astype(np.float32)
    path = room(rng)
    return ref, heard(ref, path, 900), human, 1e-3 * rng.standard_normal(SIZE).astype(np.float32), path


def unrelated_reference() -> tuple[np.ndarray, np.ndarray]:
    _, _, human, fan, _ = scene()
    return human + fan, scene(1)[0]


def swapped_channels() -> tuple[np.ndarray, np.ndarray]:
    ref, echo, human, fan, _ = scene()
    return ref, echo + human + fan


def lag_jumps_every_second() -> tuple[np.ndarray, np.ndarray]:
    ref, _, human, fan, path = scene()
    echo = np.zeros(SIZE, np.float32)
    for second, delay in enumerate((300, 4000, 900, 12000, 100, 7000)):
        part = slice(second * SAMPLE_RATE, (second + 1) * SAMPLE_RATE)
        echo[part] = heard(ref, path, delay)[part]
    return echo + human + fan, ref


def volume_turned() -> tuple[np.ndarray, np.ndarray]:
    ref, echo, human, fan, _ = scene()
    volume = 0.1 * np.repeat([0.1, 10.0, 0.3, 3.0, 0.1, 10.0], SAMPLE_RATE)
    return volume.astype(np.float32) * echo + human + fan, ref


def path_changes_at_once() -> tuple[np.ndarray, np.ndarray]:
    ref, echo, human, fan, _ = scene()
    other = -heard(ref, room(np.random.default_rng(7)), 900)
    return np.concatenate((echo[: SIZE // 2], other[SIZE // 2 :])) + human + fan, ref


def clipped_and_silent() -> tuple[np.ndarray, np.ndarray]:
    ref, echo, human, fan, _ = scene()
    mic = np.clip(5.0 * echo + human + fan, -0.3, 0.3)
    for channel, at in ((mic, 1), (ref, 2), (mic, 4), (ref, 5)):
        channel[at * SAMPLE_RATE : at * SAMPLE_RATE + SAMPLE_RATE // 2] = 0.0
    return mic, ref


def loudspeaker_muted_in_mid_word() -> tuple[np.ndarray, np.ndarray]:
    ref, echo, _, fan, _ = scene()
    echo[3 * SAMPLE_RATE + 100 : 5 * SAMPLE_RATE] = 0.0
    return echo + 0.3 * fan, ref


def square_wave() -> tuple[np.ndarray, np.ndarray]:
    ref, _, _, _, _ = scene()
    return np.sign(np.sin(np.arange(SIZE) * 0.05)).astype(np.float32), ref


SCENES = (
    unrelated_reference,
    swapped_channels,
    lag_jumps_every_second,
    volume_turned,
    path_changes_at_once,
    clipped_and_silent,
    loudspeaker_muted_in_mid_word,
    square_wave,
)


@pytest.fixture(scope="module")
def calibrated() -> Profile:
    """A calibrated robot whose path is that of the scene."""
    sweep, fan = generate_sweep(), 1e-3 * np.random.default_rng(0).standard_normal(4 * SAMPLE_RATE)
    return calibrate(sweep, heard(sweep, scene()[4], 300), fan.astype(np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("make", SCENES, ids=lambda make: make.__name__)
def test_never_louder_than_the_microphone(make, engine, calibrated):
    mic, ref = make()
    known = (calibrated,) if engine in engines.NEEDS_PROFILE else (None, calibrated)
    for at_hand in known:
        out = enhance(mic, ref, at_hand, engine=engine)
        assert np.isfinite(out).all()
        assert loudest_over_mic_db(mic, out) < 1.0, "calibrated" if at_hand else "not calibrated"


def test_the_measure_sees_an_output_that_is_too_loud():
    mic, _ = unrelated_reference()
    out = mic.copy()
    out[3 * SAMPLE_RATE : 4 * SAMPLE_RATE] *= 1.2
    assert loudest_over_mic_db(mic, out) > 1.5


def test_the_profile_of_these_scenes_is_true(calibrated):
    """Otherwise the warm half of the tests above would begin with a path that means nothing."""
    ref, echo, _, fan, _ = scene()
    out = enhance(echo + fan, ref, calibrated, engine="linear")
    assert 10 * np.log10(np.mean(echo[-SAMPLE_RATE:] ** 2) / np.mean(out[-SAMPLE_RATE:] ** 2)) > 20


@pytest.mark.slow
def test_one_loud_sample_of_the_reference_costs_the_rest_next_to_nothing(calibrated):
    """It lies in the first of two utterances, the second of which has another lag and is evaluated."""
    ref, _, _, fan, path = scene()
    pause = slice(5 * SAMPLE_RATE // 2, 7 * SAMPLE_RATE // 2)
    ref[pause] = 0.0
    echo = np.concatenate((heard(ref, path, 900)[: pause.stop], heard(ref, path, 6000)[pause.stop :]))
    power = []
    for click in (ref[2 * SAMPLE_RATE], 1e2, 1e6):
        ref[2 * SAMPLE_RATE] = click
        power.append(np.mean(enhance(echo + fan, ref, calibrated, engine="linear")[-2 * SAMPLE_RATE :] ** 2))
    assert max(power[1:]) < 1.4 * power[0]  # 1.5 dB: of the path a part is learnt again
