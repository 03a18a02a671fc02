"""A sound played and recorded on virtual devices: what was lost is said, tried again, and what was recorded is kept."""

import signal

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from tests.audio.virtual_portaudio import VirtualDevice


@pytest.fixture
def calibrate(plug, tmp_path, monkeypatch, capsys):
    """Calibrate with devices that lose nothing once buffers of so many seconds are asked for; exit code and what is said.

    at_s, then: what happens so many seconds after the start.
    """

    def calibrate(needs_s, *arguments, at_s=0.0, then=lambda *devices: None):
        speaker = VirtualDevice("speaker", "output", needs_s=needs_s)
        mic = VirtualDevice("mic", "input", hears=speaker)
        plug(mic, speaker).at(at_s, lambda: then(mic, speaker))
        code = main(["calibrate", "--live", "--output", str(tmp_path / "p.npz"), *map(str, arguments)])
        return code, capsys.readouterr().err.splitlines()

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return calibrate


def test_a_recording_with_holes_is_made_again_with_larger_buffers(calibrate, tmp_path):
    code, said = calibrate(0.3)
    assert code == 0 and (tmp_path / "p.npz").exists()
    assert [line.split(" (")[0].split(":")[0] for line in said] == [
        *("now quiet", "the recording has holes", "now quiet"),
        *("now playing", "the recording has holes", "now playing"),
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["p.npz"]  # nothing else is left behind


def test_recordings_of_a_calibration_that_failed_are_kept_and_their_place_is_said(calibrate, tmp_path):
    code, said = calibrate(10.0)
    assert code == 1 and "also with buffers of 0.6 s: close other programs" in said[-1]
    (folder,) = tmp_path.iterdir()
    assert said[-2] == f"what was recorded is kept in {folder}"
    assert {path.name for path in folder.iterdir()} == {"sweep_reference.wav", "noise_recording.wav"}
    assert soundfile.info(folder / "noise_recording.wav").frames == 6 * 16000


def interrupt(*devices):
    raise KeyboardInterrupt


def unplug(*devices):
    for device in devices:
        device.plugged = False


@pytest.mark.parametrize(
    ("happens", "code", "last"),
    [
        (unplug, 1, "input device 'mic' stopped (no sound for 6 s: unplugged, or the sound server ended): reconnect"),
        (interrupt, 130, "interrupted"),
        (lambda *devices: signal.raise_signal(signal.SIGTERM), 130, "interrupted"),
    ],
    ids=["unplugged", "SIGINT", "SIGTERM"],
)
def test_what_was_heard_of_a_sweep_that_was_not_played_to_its_end_is_kept(calibrate, tmp_path, happens, code, last):
    found, said = calibrate(0.0, at_s=10.0, then=happens)
    assert found == code and said[-1].startswith(f"edgefilter: {last}"), said
    (folder,) = tmp_path.iterdir()
    assert said[-2] == f"what was recorded is kept in {folder}"
    heard, sweep = (soundfile.read(folder / f"sweep_{name}.wav")[0] for name in ("recording", "reference"))
    begins = np.flatnonzero(heard)[0] - np.flatnonzero(sweep)[0]  # the delay of the buffers
    played = sweep[: np.flatnonzero(heard)[-1] + 1 - begins]
    assert 2 * 16000 < played.size < 4 * 16000  # 5 s of noise, a second more, and buffers come before it
    np.testing.assert_array_equal(heard[begins:][: played.size], played)


def test_an_interrupt_before_anything_was_recorded_leaves_nothing(calibrate, tmp_path):
    code, said = calibrate(0.0, then=interrupt)
    assert code == 130 and said == ["now quiet: 5 s of the robot's noise alone", "edgefilter: interrupted"]
    assert not list(tmp_path.iterdir())


def test_of_a_calibration_that_recorded_nothing_nothing_is_left(calibrate, tmp_path):
    code, said = calibrate(0.0, "--speaker", "nobody")
    assert code == 2 and "output device 'nobody' is unknown" in said[-1]
    assert not any("is kept in" in line for line in said) and not list(tmp_path.iterdir())


def test_recordings_go_where_the_user_wants_them(calibrate, tmp_path):
    code, _ = calibrate(0.0, "--save-input", tmp_path / "kept")
    assert code == 0 and len(list((tmp_path / "kept").glob("*.wav"))) == 3
