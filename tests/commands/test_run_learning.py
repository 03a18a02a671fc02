"""`edgefilter run --learn`: what a user types and sees."""

import json

import pytest
import soundfile

from edgefilter import Profile
from edgefilter.cli import main
from edgefilter.types import SAMPLE_RATE
from tests.learning.scenes import Scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("learning")
    scene = Scene(seconds=8.0)
    for name, samples in (("mic", scene.mic), ("ref", scene.reference)):
        soundfile.write(folder / f"{name}.wav", samples, SAMPLE_RATE, subtype="FLOAT")
        soundfile.write(folder / f"{name}_short.wav", samples[:SAMPLE_RATE], SAMPLE_RATE, subtype="FLOAT")
    return folder


def run(folder, *more, short=""):
    files = ["--input", str(folder / f"mic{short}.wav"), "--reference", str(folder / f"ref{short}.wav")]
    outputs = ["--output", str(folder / "out.wav"), "--json", str(folder / "run.json"), "--engine", "linear"]
    code = main(["run", *files, *outputs, "--quiet", *more])
    return code, json.loads((folder / "run.json").read_text()) if code == 0 else None


@pytest.mark.slow
def test_what_a_run_learns_is_kept_and_the_next_begins_with_it(folder, capsys):
    file = folder / "robot.npz"
    code, first = run(folder, "--learn", str(file))
    assert code == 0
    assert first["learning"]["learned"] > 0
    assert "learned" in {event["kind"] for event in first["events"]}
    assert "dB less is left of the robot" in capsys.readouterr().err
    assert Profile.load(file).learned
    code, _ = run(folder, "--learn", str(file), short="_short")
    assert code == 0
    assert "no profile" not in capsys.readouterr().err


def test_without_learning_nothing_is_learned(folder):
    code, figures = run(folder, "--no-learn", short="_short")
    assert code == 0
    assert figures["learning"] is None


def test_learning_and_not_learning_is_wrong_usage(folder):
    assert run(folder, "--learn", "x.npz", "--no-learn")[0] == 2


def test_an_engine_without_a_linear_stage_has_nothing_to_remember(folder, capsys):
    assert run(folder, "--learn", str(folder / "y.npz"), "--engine", "bypass")[0] == 2
    assert "--learn keeps what a linear stage has learned" in capsys.readouterr().err


def test_a_damaged_file_is_one_line_and_stays(folder, capsys):
    file = folder / "damaged.npz"
    file.write_bytes(b"not a profile")
    assert run(folder, "--learn", str(file))[0] == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert file.read_bytes() == b"not a profile"
