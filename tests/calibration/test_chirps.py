"""What chirps show of a set-up: simulated rooms and devices, each wrong in one way."""

import numpy as np
import pytest
import soxr

from edgefilter.calibration.chirps import CHIRP, LEAD, LEVEL_DB, chirps, evaluate
from edgefilter.commands.doctor import set_up_check

SOUND = np.pad(chirps(), (8000, 32000))
RANDOM = np.random.default_rng(1)
NOISE = 1e-3 * RANDOM.standard_normal(SOUND.size).astype(np.float32)
_TAIL = RANDOM.standard_normal(3000) * np.exp(-np.arange(3000) / 400)
_TAIL[:40], _TAIL[40] = 0, 6
ECHO = (0.3 * np.convolve(SOUND, _TAIL / np.sqrt(np.sum(_TAIL**2)))[: SOUND.size]).astype(np.float32)
LEVEL = np.sqrt(np.convolve(ECHO**2, np.ones(800) / 800, "same")) + 1e-3


def checks(mic, ref):
    found = evaluate(np.asarray(mic, np.float32), np.asarray(ref, np.float32))
    return list(set_up_check(found, "robot", "robot.monitor"))


def test_a_right_set_up_is_told_in_one_line_with_its_figures():
    (found,) = checks(np.roll(ECHO, 1352) + NOISE, SOUND)
    assert found.state == "ok" and found.found.endswith(": good")
    assert "hears the robot after 87 ms" in found.found and "clocks 0 ppm apart" in found.found
    heard = evaluate(np.roll(ECHO, 1352) + NOISE, SOUND)
    first = 8000 + LEAD
    alone = np.mean(np.square(ECHO[first : first + CHIRP])) / 1e-6
    assert heard.linear_db > 18 and abs(heard.softer_db) < 0.3
    assert heard.above_noise_db == pytest.approx(10 * np.log10(alone), abs=1)  # with the noise in it


def test_the_peak_is_what_is_stated():
    assert 20 * np.log10(np.abs(chirps()).max()) == pytest.approx(LEVEL_DB, abs=0.1)


@pytest.mark.parametrize(
    ("mic", "ref", "state", "words"),
    [
        (SOUND, SOUND, "failed", "the microphone is a copy of the reference"),
        (0.3 * SOUND + 0.01 * NOISE, SOUND, "failed", "the microphone is a copy of the reference"),
        (ECHO + NOISE, 0 * SOUND, "failed", "'robot.monitor' is silent while something is played on output 'robot'"),
        (ECHO + NOISE, NOISE, "failed", "is silent while something is played"),
        (np.roll(ECHO, -4840) + NOISE, SOUND, "failed", "the reference comes 300 ms after"),
        (np.roll(ECHO, 49000) + NOISE, SOUND, "failed", "after 3.07 s, more than the 3.0 s"),
        (NOISE, SOUND, "warning", "the microphone does not hear them"),
        (0 * NOISE, SOUND, "warning", "the microphone does not hear them"),
        (np.clip(20 * ECHO, -1, 1) + NOISE, SOUND, "warning", "clipped at the microphone"),
        (0.3 * ECHO * LEVEL**-0.4 + NOISE, SOUND, "warning", "dB louder than they should"),
        ((ECHO + NOISE) * np.minimum(LEVEL / 0.05, 1), SOUND, "warning", "dB softer than they should"),
        (np.clip(ECHO, -0.01, 0.01) + 1e-2 * NOISE, SOUND, "warning", "linear echo"),
    ],
    ids=[
        "a copy", "a softer copy", "no reference", "another reference", "late", "early by too much", "unheard", "muted",
        "clipped", "gain control", "noise suppression", "distorted",
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_and_what_to_do(mic, ref, state, words):
    found = checks(mic, ref)
    assert any(words in check.found and check.state == state and check.do for check in found), found


@pytest.mark.parametrize("ppm", [-200, 50])
def test_the_difference_of_the_clocks_is_measured(ppm):
    faster = soxr.resample(ECHO, 1e6, 1e6 + ppm, quality="VHQ")[: SOUND.size]
    heard = evaluate(np.pad(faster, (0, SOUND.size - faster.size)) + NOISE, SOUND)
    assert heard.ppm == pytest.approx(ppm, abs=3) and heard.linear_db > 12
