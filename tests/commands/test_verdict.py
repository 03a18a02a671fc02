"""A run ends with what it came to, and says what was wrong; files that cannot be meant are refused with the likely cause."""

import json
import re

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from edgefilter.commands.run import verdict_lines
from edgefilter.session import Verdict
from edgefilter.types import SAMPLE_RATE as RATE
from tests.program import DEMO


@pytest.fixture
def files(tmp_path):
    """The bundled robot alone, 9 s of it twice, and its reference backwards."""
    mic, ref = (np.tile(soundfile.read(DEMO / f"{name}.flac")[0][: 9 * RATE], 2) for name in ("mic", "reference"))
    for name, sound in (("mic", mic), ("ref", ref), ("other", ref[::-1])):
        soundfile.write(tmp_path / f"{name}.wav", sound, RATE)
    return tmp_path


def ran(files, mic, ref, capsys, *more):
    names = [str(files / f"{name}.wav") for name in (mic, ref, "out")]
    words = ["run", "--input", names[0], "--reference", names[1], "--output", names[2], "--json", str(files / "o.json")]
    assert main([*words, *more]) == 0
    return json.loads((files / "o.json").read_text()), capsys.readouterr().err


@pytest.mark.slow
def test_a_run_says_how_much_of_the_robot_was_removed_at_which_lag_and_how_often_a_human_was_noticed(files, capsys):
    figures, told = ran(files, "mic", "ref", capsys, "--engine", "crnn", "--no-learn")
    verdict = figures["verdict"]
    assert verdict["removed_db"] > 15.0 and verdict["lag_ms"] == pytest.approx(352, abs=3)
    assert verdict["noticed"] == 0 and verdict["wrong"] == []
    assert (
        "lowered by" in told and "352 ms after the reference; a human was noticed never" in told and "wrong" not in told
    )


def test_a_run_says_which_of_the_two_sounds_it_gives(files, capsys):
    given = ran(files, "ref", "other", capsys, "--engine", "bypass", "--no-learn", "--sound", "listen")[0]
    assert given["output"] == "listen"


@pytest.mark.slow
def test_a_reference_of_another_recording_is_said_at_the_end(files, capsys):
    figures, told = ran(files, "mic", "other", capsys, "--engine", "linear", "--no-learn")
    assert figures["verdict"]["lag_ms"] is None and len(figures["verdict"]["wrong"]) == 1
    assert figures["verdict"]["removed_db"] is None and "lowered" not in told
    assert re.search(r"wrong: at \d+\.\d s the (reference|microphone)", told)


@pytest.mark.slow
def test_one_file_given_twice_is_said_and_nothing_is_learned_from_it(files, capsys):
    figures, told = ran(files, "ref", "ref", capsys, "--engine", "linear")
    assert "same signal" in figures["verdict"]["wrong"][0] and "learned path" not in told
    assert figures["learning"]["learned"] == 0


def test_a_verdict_in_words():
    assert verdict_lines(Verdict(31.25, 98.4, 1, ())) == [
        "while it talked alone, the robot was lowered by 31.2 dB, heard 98 ms after the reference; a human was noticed once"
    ]
    assert verdict_lines(Verdict(None, None, None, ("it is late",))) == ["wrong: it is late"]
    assert "heard 23 ms before the reference" in verdict_lines(Verdict(3.0, -23.4, 4, ()))[0]
    assert verdict_lines(Verdict(3.0, None, 4, ()))[0].endswith("lowered by 3.0 dB; a human was noticed 4 times")


@pytest.mark.parametrize("command", ["compare", "diagnose", "passport"])
def test_one_file_given_twice_is_refused_with_the_likely_cause(files, command, capsys):
    profile = [] if command == "passport" else ["--profile", str(DEMO / "profile.npz")]
    names = ["--recording", str(files / "mic.wav"), "--reference", str(files / "mic.wav")]
    assert main([command, *profile, *names]) == 1
    (line,) = [each for each in capsys.readouterr().err.splitlines() if each.startswith("edgefilter: ")]
    assert "same signal" in line and "loudspeaker" in line


@pytest.mark.parametrize("command", ["compare", "diagnose", "passport"])
@pytest.mark.parametrize(
    ("recording", "reference", "cause"),
    [("mic", "other", "does not contain the reference"), ("ref", "mic", "seem to be swapped")],
)
def test_an_unrelated_reference_and_swapped_files_are_refused(files, command, recording, reference, cause, capsys):
    names = ["--recording", str(files / f"{recording}.wav"), "--reference", str(files / f"{reference}.wav")]
    for profile in ([], ["--profile", str(DEMO / "profile.npz")])[: 1 + (command != "passport")]:
        assert main([command, *profile, *names]) == 1
        assert cause in capsys.readouterr().err
