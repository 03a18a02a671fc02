"""The virtual microphone is the filter's own output: as its input it is refused, whatever people type for it."""

import pytest

from edgefilter.cli import main
from tests.audio.virtual_portaudio import VirtualDevice

INPUTS = ["alsa_input.usb-Acme", "edgefilter_speaker.monitor", "edgefilter_human.monitor", "edgefilter_mic"]


@pytest.fixture
def served(plug, tmp_path, monkeypatch):
    """A sound server with the virtual devices, whose default microphone is the virtual one, and which a program tells of."""
    plug(VirtualDevice("pulse", "input"), VirtualDevice("HDA Intel", "input"), VirtualDevice("HDA Intel", "output"))
    listed = "".join(f"{number}\\t{name}\\n" for number, name in enumerate(INPUTS))
    program = tmp_path / "pactl"
    program.write_text(
        f"#!/bin/sh\ncase \"$*\" in\n'list short sources') printf '{listed}' ;;\nget-default-*) echo edgefilter_mic ;;\nesac\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))


@pytest.mark.parametrize("command", ["run", "doctor"])
@pytest.mark.parametrize(
    "typed",
    ["edgefilter_mic", "EDGEFILTER_MIC", "filter mic", "edgefilter_human.monitor", "human", "mic", "MIC", "pulse", "0"],
)  # fmt: skip
def test_the_filters_own_output_is_refused_as_its_microphone_by_any_part_of_its_name(served, capsys, command, typed):
    assert main([command, "--input", typed, *(["--output", "x.wav"] if command == "run" else [])]) != 0
    said = "".join(capsys.readouterr())
    assert "is edgefilter's own output" in said and "set-default-source" in said
    assert command == "run" or "failed   microphone" in said


def test_a_measurement_is_not_recorded_from_the_filters_own_output(served, tmp_path, capsys):
    live = ["calibrate", "--live", "--speaker", "hda", "--input", "filter mic", "--output", str(tmp_path / "robot.npz")]
    assert main(live) != 0
    assert "is edgefilter's own output" in "".join(capsys.readouterr())
    assert not (tmp_path / "robot.npz").exists()


@pytest.mark.parametrize("typed", ["acme", "hda", "1"])
def test_another_microphone_is_not_taken_for_the_filters_own_output(served, capsys, typed):
    main(["doctor", "--input", typed, "--no-chirp"])
    assert "edgefilter's own output" not in "".join(capsys.readouterr())
