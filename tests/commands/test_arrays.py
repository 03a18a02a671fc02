"""Several microphones on the command line: files whose channels are microphones, the profile of an array, turns."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE
from tests.filter.array_scene import calibration, talk
from tests.program import here, one_line


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a device: channel 0 processed, 1 to 3 microphones, 4 what is played; and the profile of 1 to 3."""
    made = tmp_path_factory.mktemp("array")
    mic, ref, _ = talk()
    soundfile.write(made / "five.wav", np.column_stack((0.1 * mic[:, 0], mic, ref)), SAMPLE_RATE, "FLOAT")
    calibration(3).save(made / "three.npz")
    return made


def run(folder: Path, *more: object) -> object:
    return here("run", "--input", folder / "five.wav", "--output", folder / "out.wav", "--quiet", *more)


@pytest.mark.slow
def test_a_device_with_its_reference_among_its_channels(folder: Path) -> None:
    result = run(
        folder, "--mic-channels", "1,2,3", "--reference-channel", 4, "--profile", folder / "three.npz", "--engine", "ss",
        "--json", folder / "run.json", "--record", folder / "record", "--no-learn",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "channels 1, 2, 3 of 5" in result.stderr and "channel 4 of 5" in result.stderr
    figures = json.loads((folder / "run.json").read_text())
    assert figures["array"] == {"microphones": 3, "reference": 0, "left_out": {}}
    mic, ref, _ = talk()
    out, _ = soundfile.read(folder / "out.wav")
    assert out.shape == ref.shape
    assert np.mean(out[2 * SAMPLE_RATE : 3 * SAMPLE_RATE] ** 2) < 0.01 * np.mean(
        mic[2 * SAMPLE_RATE : 3 * SAMPLE_RATE] ** 2
    )
    assert np.array_equal(soundfile.read(folder / "record" / "mic.wav", dtype="float32")[0], mic)
    assert Profile.load(folder / "record" / "profile.npz").microphones == 3


def test_without_being_named_channels_are_averaged_and_it_is_said(folder: Path) -> None:
    result = run(folder, "--engine", "bypass")
    assert (
        result.returncode == 0 and "5 channels averaged to one" in result.stderr and "--mic-channels" in result.stderr
    )


@pytest.mark.slow
def test_what_cannot_be_is_one_line_and_the_output_is_left_alone(folder: Path) -> None:
    (folder / "out.wav").write_bytes(b"kept")
    profile = ("--profile", folder / "three.npz")
    one_line(
        run(folder, "--mic-channels", "1,2", *profile), 1, "the profile holds 3 microphones, found 2", "--mic-channels"
    )
    one_line(run(folder, *profile), 1, "holds 3 microphones, found 1")
    one_line(run(folder, "--mic-channels", "1,5"), 1, "has 5 channels, 0 to 4, found channel 5")
    one_line(run(folder, "--mic-channels", "1,1"), 2, "'1,1' does not name one to 8 different channels")
    one_line(run(folder, "--mic-channels", "-1"), 2, "--mic-channels")
    one_line(
        run(folder, "--reference-channel", "4"), 2, "reference_channel is 4, expected mic_channels that name the others"
    )
    both = ("--mic-channels", "1,2", "--reference-channel", "4", "--reference", folder / "five.wav")
    one_line(run(folder, *both), 2, "--reference-channel is the reference, found --reference too")
    one_line(
        run(folder, "--engine", "ss", "--turns", folder / "turns"),
        2,
        "--turns needs an engine that detects speech, and ss does not",
    )
    assert (folder / "out.wav").read_bytes() == b"kept"


@pytest.mark.slow
def test_calibrate_takes_the_microphones_that_are_named(folder: Path) -> None:
    from edgefilter import generate_sweep
    from tests.filter.array_scene import PATHS, fan

    sweep = generate_sweep()
    heard = np.stack([np.convolve(sweep, path)[: sweep.size] for path in PATHS[:3]], 1) + 1e-3 * fan(sweep.size, 3, 3)
    soundfile.write(folder / "sweep.wav", sweep, SAMPLE_RATE, "FLOAT")
    soundfile.write(folder / "heard.wav", heard, SAMPLE_RATE, "FLOAT")
    soundfile.write(folder / "fan.wav", 1e-3 * fan(64000, 3, 4), SAMPLE_RATE, "FLOAT")
    recordings = ("--sweep-reference", folder / "sweep.wav", "--sweep-recording", folder / "heard.wav")
    result = here(
        "calibrate", *recordings, "--noise-recording", folder / "fan.wav", "--mic-channels", "2,0", "--output",
        folder / "two.npz", "--json", "-",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    profile = Profile.load(folder / "two.npz")
    assert profile.microphones == 2 and json.loads(result.stdout)["microphones"] == 2
    peaks = [int(np.argmax(np.abs(path))) for path in profile.running_responses()]
    assert peaks[1] - peaks[0] == -2  # channel 0 hears the robot two samples before channel 2


@pytest.mark.slow
def test_turns_are_written_to_files_of_their_own(tmp_path: Path) -> None:
    from edgefilter.filter.budget import DEMO

    result = here(
        "run", "--input", DEMO / "mic.flac", "--reference", DEMO / "reference.flac", "--profile", DEMO / "profile.npz",
        "--engine", "crnn", "--no-learn", "--output", tmp_path / "out.wav", "--turns", tmp_path / "turns", "--quiet",
        "--json", tmp_path / "run.json",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    events = json.loads((tmp_path / "run.json").read_text())["events"]
    ended = [event for event in events if event["kind"] == "speech_stopped"]
    files = sorted((tmp_path / "turns").iterdir())
    assert len(files) == len(ended) > 0 and files[0].name == "turn_0001.wav"
    whole, turn = (soundfile.read(path, dtype="int16")[0] for path in (tmp_path / "out.wav", files[0]))
    # with one microphone the turn is what was streamed
    end = round(ended[0]["seconds"] * SAMPLE_RATE)
    assert any(np.array_equal(whole[at : at + turn.size], turn) for at in range(max(end - turn.size - 2048, 0), end))
