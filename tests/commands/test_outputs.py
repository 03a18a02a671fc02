"""No output of any command is ever one of its inputs, or written twice, however the paths are typed.

Then nothing is touched.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from edgefilter.cli import build_parser, main
from edgefilter.commands.outputs import FOLDERS, READ, WRITTEN
from tests.diagnosis.robot_scene import profile
from tests.program import edgefilter

NEITHER = {
    "mic_channels", "reference_channel", "reference_channels", "channel",
    "help", "version", "debug", "command", "word", "engine", "budget_ms", "remeasure", "seconds", "quiet", "live",
    "speaker", "level_db", "effect", "force", "prove", "verbose", "no_learn", "on_barge_in", "on_suspicion", "confirm_s", "ask_db", "barge_in",
    "sound", "threshold",
    "setup", "load", "unload",
    "hidden", "multisine",
    "no_chirp", "false_rate",
    "no_diagnosis",
    "human_db",
    "explanation",
    "mic",
    "silenced",
    "human",
    "domain",
    "rate",
    "channels",
    "host",
    "port",
    "streams",
}  # fmt: skip


@pytest.fixture
def heard(tmp_path, monkeypatch):
    """A folder like one that --record made, a profile and a user's effect in it.

    The working directory is beside it.
    """
    folder = tmp_path / "heard"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for name in ("mic", "reference"):
        soundfile.write(folder / f"{name}.wav", 0.1 * rng.standard_normal(8000), 16000, "FLOAT")
    profile().save(folder / "robot.npz")
    (folder / "own.py").write_text("raise SystemExit('nothing may run before the check')")
    (folder / "soft.wav").symlink_to(folder / "mic.wav")
    (folder / "hard.json").hardlink_to(folder / "mic.wav")
    (folder / "inside").symlink_to(folder)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return folder


def content(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused(heard, capsys, words, *expected):
    """Exit 2, one line with what was expected in it, and every file as it was."""
    before = content(heard.parent)
    assert main([str(word) for word in words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("edgefilter: "), lines
    for part in expected:
        assert part in lines[0], lines[0]
    assert content(heard.parent) == before


def run(heard, *more):
    return ["run", "--input", heard / "mic.wav", "--reference", heard / "reference.wav", "--engine", "bypass", *more]


def test_record_over_the_recording_that_is_being_filtered_does_not_destroy_it(heard, capsys):
    refused(
        heard,
        capsys,
        run(heard, "--output", "out.wav", "--record", heard),
        "--record",
        "mic.wav",
        "overwritten",
    )
    refused(
        heard,
        capsys,
        run(heard, "--output", "out.wav", "--record", "../heard"),
        "--record",
        "mic.wav",
        "overwritten",
    )


@pytest.mark.parametrize(
    "typed",
    [
        "../heard/mic.wav",
        "../heard/../heard/mic.wav",
        "../heard/soft.wav",
        "../heard/hard.json",
        "../heard/inside/mic.wav",
    ],
)
@pytest.mark.parametrize("option", ["--json", "--output", "--save-profile"])
def test_an_input_is_recognised_however_its_path_is_typed(heard, capsys, typed, option):
    rest = [] if option == "--output" else ["--output", "out.wav"]
    refused(heard, capsys, run(heard, *rest, option, typed), option, "also an input", "mic.wav")


def test_an_input_in_other_case_is_the_same_file_where_the_file_system_says_so(heard, capsys, monkeypatch):
    """A file system that ignores case, played by one that answers for MIC.WAV with mic.wav."""
    true_stat = os.stat
    monkeypatch.setattr(os, "stat", lambda path, **more: true_stat(str(path).replace("MIC.WAV", "mic.wav"), **more))
    refused(heard, capsys, run(heard, "--output", heard / "MIC.WAV"), "also an input")


def every_pair():
    """(command, inputs, output option) for each command: whatever it reads against whatever it writes."""
    alone = ["--profile", "robot.npz", "--recording", "mic.wav", "--reference", "reference.wav", "--effects", "own.py"]
    sweep = ["--sweep-reference", "mic.wav", "--sweep-recording", "reference.wav", "--noise-recording", "robot.npz"]
    moving = [*sweep, "--while-moving", "mic.wav", "reference.wav"]
    filtered = ["--input", "mic.wav", "--reference", "reference.wav", "--profile", "robot.npz", "--effects", "own.py"]
    for name, given, outputs in (
        ("compare", alone, ("--json", "--report")),
        ("diagnose", alone, ("--json", "--report")),
        ("add playback_gain", alone, ("--json", "--output")),
        ("remove playback_gain", ["--profile", "robot.npz", "--effects", "own.py"], ("--json", "--output")),
        ("calibrate", sweep, ("--json", "--output")),
        ("calibrate", moving, ("--output",)),
        ("profile show", ["robot.npz", "--effects", "own.py"], ("--json", "--plot")),
        ("run", filtered, ("--json", "--output", "--save-profile", "--learn")),
    ):
        for output in outputs:
            for file in [word for word in given if "." in word]:
                yield pytest.param(name.split(), given, output, file, id=f"{name} {output} {file}")


@pytest.mark.parametrize(("command", "given", "option", "file"), list(every_pair()))
def test_no_command_writes_over_what_it_reads(heard, capsys, command, given, option, file):
    words = [*command, *(heard / word if "." in word else word for word in given), option, heard / file]
    needed = (
        ["--output", "x.wav"] if option != "--output" and command[0] in ("run", "add", "remove", "calibrate") else []
    )
    refused(heard, capsys, [*words, *needed], option, "also an input", file)


def test_the_demo_does_not_write_over_its_own_recording(heard, capsys):
    own = Path(sys.modules["edgefilter"].__file__).parent / "demo_data/mic.flac"
    before = own.read_bytes()
    refused(heard, capsys, ["demo", "--output", "d", "--json", own], "--json", "also an input")
    assert own.read_bytes() == before


def test_a_model_that_the_environment_names_is_not_written_over(heard, capsys, monkeypatch):
    monkeypatch.setenv("EDGEFILTER_CRNN", str(heard / "robot.npz"))
    refused(
        heard,
        capsys,
        run(heard, "--output", "o.wav", "--json", heard / "robot.npz"),
        "also an input",
        "EDGEFILTER_CRNN",
    )


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["run", "--input", "mic.wav", "--output", "o.wav", "--json", "./o.wav"], ("--json", "--output")),
        (["run", "--input", "mic.wav", "--output", "new/mic.wav", "--record", "new"], ("--record", "--output")),
        (["run", "--input", "mic.wav", "--output", "o.wav", "--json", "O.WAV"], ("--json", "--output")),
        (
            "compare --recording mic.wav --reference reference.wav --json r --report ../heard/r".split(),
            ("--report", "--json"),
        ),
        (["demo", "--output", "d", "--json", "d/filtered.wav"], ("--json", "--output")),
        (
            ["calibrate", "--live", "--output", "s/sweep_recording.wav", "--save-input", "s"],
            ("--save-input", "--output"),
        ),
    ],
)
def test_two_outputs_that_are_one_file_are_refused(heard, capsys, monkeypatch, words, parts):
    monkeypatch.chdir(heard)
    refused(heard, capsys, words, "same file", *parts)


@pytest.mark.slow
def test_standard_input_and_output_are_seen_through(heard):
    before = content(heard)
    with open(heard / "mic.wav", "rb") as file:
        done = edgefilter("run", "--input", "-", "--engine", "bypass", "--output", heard / "mic.wav", stdin=file)
    assert done.returncode == 2 and "also an input (input -)" in done.stderr
    with open(heard / "mic.wav", "ab") as file:
        done = edgefilter(*run(heard, "--output", "-"), stdout=file)
    assert done.returncode == 2 and "--output - is also an input" in done.stderr
    done = edgefilter(*run(heard, "--output", "-", "--json", "-"))
    assert done.returncode == 2 and "mix on standard output" in done.stderr
    assert content(heard) == before


def test_devices_and_streams_that_writing_cannot_destroy_are_allowed_twice(heard):
    assert main([str(word) for word in run(heard, "--output", "o.wav", "--json", "/dev/null", "--quiet")]) == 0
    words = [
        "compare",
        "--recording",
        heard / "none.wav",
        *"--reference /dev/null --json /dev/null --report /dev/null".split(),
    ]
    assert main([str(word) for word in words]) == 1  # for the recording that is not there, not for the devices


@pytest.mark.parametrize(
    ("path", "why"),
    [("no/x", "No such file"), ("../heard", "Is a directory"), ("../heard/own.py/x", "Not a directory")],
)
@pytest.mark.parametrize("option", ["--json", "--save-profile"])
def test_a_result_that_could_not_be_written_in_the_end_is_said_before_the_work(heard, capsys, option, path, why):
    words = [str(word) for word in run(heard, "--output", "o.wav", option, path)]
    before = content(heard.parent)
    assert main(words) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and option in lines[0] and path in lines[0] and why in lines[0]
    assert content(heard.parent) == before


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--input", "heard/mic.wav", "--output", "o.wav", "--save-profile", "pipe"],
        ["run", "--input", "heard/mic.wav", "--output", "o.wav", "--learn", "pipe"],
        ["diagnose", "--recording", "heard/mic.wav", "--reference", "heard/reference.wav", "--apply", "pipe"],
        ["remove", "rattle", "--profile", "heard/robot.npz", "--output", "pipe"],
    ],
)
def test_a_profile_cannot_replace_a_pipe_which_is_said_before_the_work(heard, capsys, monkeypatch, words):
    monkeypatch.chdir(heard.parent)
    os.mkfifo("pipe")
    before = content(heard.parent)
    assert main(words) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "pipe cannot be written: a file cannot replace it" in line
    assert content(heard.parent) == before and Path("pipe").is_fifo()


def test_a_dash_where_no_stream_is_meant_is_refused(heard, capsys):
    refused(
        heard, capsys, run(heard, "--output", "o.wav", "--save-profile", "-"), "--save-profile -", "standard output"
    )
    refused(
        heard,
        capsys,
        ["remove", "rattle", "--profile", heard / "robot.npz", "--output", "-"],
        "--output -",
        "standard output",
    )


def test_every_option_of_every_command_is_known_to_the_check():
    """A new option that names a file has to be entered in READ, WRITTEN or FOLDERS."""

    def options(parser):
        for action in parser._actions:
            yield action.dest
            if isinstance(action, argparse._SubParsersAction):
                for child in action.choices.values():
                    yield from options(child)

    known = {*READ, *WRITTEN, *(option for _, option in FOLDERS)}
    found = set(options(build_parser()))
    assert found - known == NEITHER and known <= found
