"""What a recording says of the microphones of an array: each defect by the channel that has it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from edgefilter import Profile, ProfileError, SignalError
from edgefilter.diagnosis.channels import doubtful_channels, is_clipped
from edgefilter.types import SAMPLE_RATE
from tests.filter.array_scene import PATHS, calibration, fan, noise, talk
from tests.program import here, one_line


@pytest.fixture
def mics() -> np.ndarray:
    """(3, n) of the robot, and from 3 to 5 s a human."""
    return np.ascontiguousarray(talk()[0].T)


def test_microphones_as_they_were_calibrated_are_not_doubted_whatever_the_volume_and_the_lag(mics: np.ndarray) -> None:
    ref = talk()[1]
    for gain, late in ((1.0, 0), (0.2, 4000), (3.0, -700)):
        assert doubtful_channels(calibration(3), np.roll(gain * mics, late, axis=1).astype(np.float32), ref) == {}
    with pytest.raises(SignalError, match="holds 3 microphones, found 2: name those that were calibrated"):
        doubtful_channels(calibration(3), mics[:2], ref)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: 0.0 * x, "silent, every sample is 0"),
        (lambda x: np.clip(x, -0.3 * x.max(), 0.3 * x.max()), "clipped at"),
        (lambda x: 2.0 * x, "another gain, +6.0 dB"),
        (lambda x: 0.5 * x, "another gain, -6.0 dB"),
        (lambda x: np.std(x) * noise(x.size, 9), "hears the robot otherwise"),
        (lambda x: 0.15 * x + np.std(x) * noise(x.size, 9), "hears the robot otherwise"),
    ],
)
@pytest.mark.parametrize("at", [0, 2])
def test_a_defect_is_named_at_its_channel(mics: np.ndarray, change, words: str, at: int) -> None:
    mics[at] = change(mics[at])
    found = doubtful_channels(calibration(3), mics, talk()[1])
    assert list(found) == [at] and found[at].startswith(words)


@pytest.mark.parametrize(("drive", "cut"), [(0.0, False), (4.2, False), (5.0, True)])
def test_a_sound_that_lingers_at_its_top_is_not_cut_yet(drive: float, cut: bool) -> None:
    """Of a sine there is as much at the top as beside it, bent so 2.5 times as much, and bent more 4 times."""
    sine = np.sin(2 * np.pi * np.arange(SAMPLE_RATE) * 0.01237)
    bent = np.abs(np.tanh(drive * sine) if drive else sine)
    assert is_clipped(bent / bent.max()) is cut


def test_exchanged_channels_and_copies_are_named(mics: np.ndarray) -> None:
    found = doubtful_channels(calibration(3), mics[[0, 2, 1]], talk()[1])
    assert found == {
        1: "exchanged: it hears the robot as channel 2 was calibrated to",
        2: "exchanged: it hears the robot as channel 1 was calibrated to",
    }
    mics[1] = mics[0]
    assert doubtful_channels(calibration(3), mics, talk()[1]) == {1: "the same sound as channel 0"}


def test_a_profile_of_one_of_the_microphones() -> None:
    profile = calibration(3)
    third = profile.of_microphone(2)
    assert third.microphones == 1
    assert np.array_equal(third.echo.impulse_response, profile.array.responses[1])
    assert np.array_equal(third.noise_psd, profile.array.noise[:, 2, 2, 0])
    assert profile.of_microphone(0).microphones == 1
    with pytest.raises(ProfileError, match="holds 3 microphones, found microphone 3"):
        profile.of_microphone(3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a device of five channels, the robot alone in 1 to 3; the third is turned up by 6 dB."""
    made = tmp_path_factory.mktemp("channels")
    said = np.tile(talk()[1][: 3 * SAMPLE_RATE], 3)
    heard = np.stack([np.convolve(said, path)[: said.size] for path in PATHS[:3]], 1) + 1e-3 * fan(said.size, 3, 21)
    heard[:, 2] *= 2.0
    soundfile.write(made / "five.wav", np.column_stack((said, heard, said)), SAMPLE_RATE, "FLOAT")
    soundfile.write(made / "said.wav", said, SAMPLE_RATE, "FLOAT")
    calibration(3).save(made / "three.npz")
    return made


def diagnose(folder: Path, *more: object):
    recording = ("--recording", folder / "five.wav", "--reference", folder / "said.wav")
    return here("diagnose", *recording, "--profile", folder / "three.npz", *more)


@pytest.mark.slow
def test_any_channel_is_diagnosed_and_all_are_looked_at(folder: Path) -> None:
    result = diagnose(folder, "--mic-channels", "1,2,3", "--channel", 3, "--json", folder / "found.json")
    assert result.returncode == 0, result.stderr
    assert "channel 3: another gain, +6.0 dB" in result.stdout
    found = json.loads((folder / "found.json").read_text())
    assert list(found["channels"]) == ["3"]
    assert "playback_gain" in [one["effect"] for one in found["ranking"]], "6 dB louder than its own path"


@pytest.mark.slow
def test_what_cannot_be_diagnosed_is_one_line(folder: Path) -> None:
    one_line(diagnose(folder, "--channel", 1), 2, "--channel without --mic-channels")
    one_line(
        diagnose(folder, "--mic-channels", "1,2,3", "--channel", 4), 2, "--channel 4 is none of the microphones 1, 2, 3"
    )
    one_line(diagnose(folder, "--mic-channels", "1,2"), 1, "holds 3 microphones, found 2")
    asked = ("--mic-channels", "1,2,3", "--channel", 2, "--apply", folder / "out.npz")
    one_line(diagnose(folder, *asked), 2, "--apply writes the profile of the first microphone")


@pytest.mark.slow
def test_what_was_found_is_written_for_all_microphones(folder: Path) -> None:
    heard, rate = soundfile.read(folder / "five.wav", dtype="float32")
    heard[:, 1:4] *= 2.0
    soundfile.write(folder / "louder.wav", heard, rate, "FLOAT")
    louder = ("--recording", folder / "louder.wav")  # the later option counts
    result = diagnose(folder, *louder, "--mic-channels", "1,2,3", "--apply", folder / "again.npz")
    assert result.returncode == 0, result.stderr
    assert Profile.load(folder / "again.npz").microphones == 3
