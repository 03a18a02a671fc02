"""A robot that moves while it talks: what its calibration has heard is expected from the first word on, and is no human."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from scipy import signal

from edgefilter import EgoFilter, Profile, calibrate_moving, cli
from edgefilter.dsp.psd import GRID_BINS
from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import CalibrationError
from edgefilter.filter.barge_in import OwnVoice
from edgefilter.filter.residual_echo import Residual
from edgefilter.profile.data import GRID_HZ
from edgefilter.profile.while_moving import WhileMoving
from tests.program import CALIBRATION, DEMO, demo

STFT = StftConfig()
RATE, MOTORS_HZ, MOTORS_DB = 16_000, 2000.0, -12.0
SAID, HEARD, HUMAN = demo("reference", "mic", "human")
ALONE = HEARD - HUMAN
KNOWN = Profile.load(DEMO / "profile.npz")


def moving(seed: int) -> np.ndarray:
    """The robot alone, and motors that go with its voice, so much softer."""
    sound = np.random.default_rng(seed).standard_normal(ALONE.size)
    sound = signal.lfilter(*signal.iirpeak(MOTORS_HZ, 3.0, RATE), sound) * signal.oaconvolve(
        np.abs(ALONE), np.ones(4000), "same"
    )
    return (ALONE + 10 ** (MOTORS_DB / 20) * ALONE.std() / sound.std() * sound).astype(np.float32)


@pytest.fixture(scope="module")
def taught() -> Profile:
    return calibrate_moving(KNOWN, moving(1), SAID)


def test_level_and_spectrum_of_the_motors_are_what_they_are(taught):
    heard = taught.while_moving
    # below an echo at its peak, which is louder than in the mean
    assert MOTORS_DB - 10 < heard.level_db < MOTORS_DB and 8 < heard.seconds < SAID.size / RATE
    assert abs(GRID_HZ[heard.density.argmax()] - MOTORS_HZ) < 200
    assert replace(taught, while_moving=None).echo is KNOWN.echo
    still = calibrate_moving(KNOWN, np.append(ALONE, 0.0), SAID).while_moving  # whatever comes after the voice
    assert still.level_db < heard.level_db - 10 and still.moments <= heard.moments


def test_motors_are_expected_from_the_first_word_on(taught):
    """Twice what the calibration has heard of them, where the echo is there and nothing was learned yet."""
    echo, nothing = np.zeros((2, STFT.bins), np.float32)
    echo[10:40] = 1.0
    at = round(MOTORS_HZ / STFT.frequencies[1])
    known, unknown = (
        Residual(STFT, robot).step(echo.astype(np.complex64), nothing.astype(np.complex64), nothing)[1][at]
        for robot in (taught, KNOWN)
    )
    share = taught.while_moving.with_voice(STFT)[at]
    assert known - unknown == pytest.approx(2.0 * 30.0 * share, rel=0.2)


def test_a_human_as_loud_as_the_motors_is_heard_beside_them(taught):
    ego, heard, started = EgoFilter(taught), moving(2) + 10 ** (11 / 20) * HUMAN, []
    begins = np.flatnonzero(np.abs(HUMAN) > 0.1 * np.abs(HUMAN).max())[0]
    for at in range(0, heard.size, RATE):
        ego.process(heard[at : at + RATE], SAID[at : at + RATE])
        started += [event.sample for event in ego.events() if event.kind == "speech_started"]
        if started:
            break
    assert started and begins < started[0] < begins + RATE


def test_the_rate_goes_on_from_what_the_calibration_has_counted():
    learning = OwnVoice(0.016)
    for _ in range(20):
        for odds in (2.0, *[-3.0] * 99):
            learning.note(odds, False)
    moments, seconds = learning.counted
    assert moments == pytest.approx(20, rel=0.15) and seconds == pytest.approx(32, rel=0.15)
    before = WhileMoving(np.zeros(GRID_BINS, np.float32), moments, seconds)
    assert OwnVoice(0.016, before).higher == pytest.approx(learning.higher) and learning.higher > 1.0


@pytest.mark.parametrize(
    ("recording", "said"),
    [
        (0.01 * np.random.default_rng(0).standard_normal(8 * RATE), SAID[: 8 * RATE]),
        (ALONE[: 3 * RATE], SAID[: 3 * RATE]),
    ],
)
def test_a_robot_that_is_not_heard_is_refused(recording, said):
    with pytest.raises(CalibrationError, match="of the moving robot, expected at least 5: let it talk"):
        calibrate_moving(KNOWN, recording, said)


def test_the_command_takes_the_recording_of_a_moving_robot(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    soundfile.write("mic.wav", moving(1), RATE, "FLOAT")
    files = [
        ("--sweep-reference", "sweep_reference"),
        ("--sweep-recording", "sweep_recording"),
        ("--noise-recording", "fan"),
    ]
    words = ["calibrate", *(word for option, name in files for word in (option, str(CALIBRATION / f"{name}.flac")))]
    words += ["--output", "robot.npz", "--json", "robot.json", "--while-moving"]
    assert cli.main([*words, "mic.wav", str(DEMO / "reference.flac")]) == 0
    told = json.loads((tmp_path / "robot.json").read_text())["while_moving"]
    kept = Profile.load("robot.npz").while_moving
    assert told == {"level_db": kept.level_db, "moments": kept.moments, "seconds": kept.seconds}
    assert f"what sounds with the voice is {-kept.level_db:.0f} dB below it" in capsys.readouterr().out
    for given, wrong in (
        (["mic.wav"], "got 1 files, expected two"),
        ([], "got 0 files"),
        (["mic.wav", "mic.wav", "--live"], "--live makes"),
    ):
        assert cli.main([*words, *given]) == 2
        assert wrong in capsys.readouterr().err
