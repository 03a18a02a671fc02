"""`edgefilter doctor` on machines that lack something: each finding says what to do, and the exit code tells."""

import json
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from edgefilter.audio.device import input_port
from edgefilter.audio.measure import listen
from edgefilter.cli import main
from edgefilter.commands import doctor
from edgefilter.commands.doctor import Check
from edgefilter.filter.budget import held_to
from tests.audio.conftest import plug  # noqa: F401
from tests.audio.virtual_portaudio import VirtualDevice


@pytest.mark.parametrize(
    ("checks", "code", "last"),
    [
        ([Check("cores", "ok", "4"), Check("level", "warning", "-90 dB", "raise it")], 0, "fit for a live run"),
        (
            [Check("cores", "ok", "4"), Check("reference", "failed", "none")],
            1,
            "not fit for a live run: reference failed",
        ),
    ],
)
def test_what_failed_decides_and_what_to_do_is_said(checks, code, last, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(doctor, "examine", lambda *_: iter(checks))
    assert main(["doctor", "--json", str(tmp_path / "d.json")]) == code
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 3 and said[-1] == last and said[1].startswith(checks[1].state)
    assert main(["doctor", "--json", "-"]) == code
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "d.json").read_text()
    assert json.loads(printed)["fit"] == (code == 0) and len(json.loads(printed)["checks"]) == 2


@pytest.fixture
def no_server(monkeypatch):
    """A machine without the programs that ask the sound server."""
    monkeypatch.setenv("PATH", "")


def test_what_is_missing_is_found_and_the_rest_still_checked(monkeypatch, no_server):
    monkeypatch.setenv("EDGEFILTER_CRNN", "gone.onnx")
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with held_to(1):
        found = {check.name: check for check in doctor.examine("mic", None, None)}
    assert {name for name, check in found.items() if check.state == "failed"} == {"model", "microphone", "reference"}
    assert {name for name, check in found.items() if check.state == "warning"} == {"cores", "sound server"}
    assert "gone.onnx" in found["model"].found and "pip install sounddevice" in found["microphone"].found
    assert "allow another core" in found["cores"].do and "start PulseAudio" in found["sound server"].do
    assert found["engine"].state == "ok" and found["engine"].found.startswith("ss,")


@pytest.mark.parametrize(
    ("ppm", "level", "states", "words"),
    [
        (500.0, 0.01, ["ok", "ok"], "-40 dB"),
        (-8e4, 0.01, ["failed", "ok"], "loses samples"),
        (0.0, 0.0, ["ok", "warning"], "unmute"),
        (0.0, 1e-4, ["ok", "warning"], "raise"),
        (0.0, 1.0, ["ok", "warning"], "clipped"),
    ],
)
def test_clock_and_level_are_checked(plug, no_server, monkeypatch, ppm, level, states, words):  # noqa: F811
    monkeypatch.setenv("EDGEFILTER_CRNN", "gone.onnx")  # an engine that is timed sooner
    plug(VirtualDevice("microphone", "input", ppm=ppm, level=level))
    checks = {check.name: check for check in doctor.examine("default", None, None)}
    found = [checks["mic clock"], checks["level"]]
    assert [check.state for check in found] == states
    assert words in " ".join(check.found + check.do for check in found)


def test_another_model_than_the_package_s_is_said(monkeypatch):
    own = Path(__file__).parents[2] / "models/crnn_20ms_int8.onnx"
    monkeypatch.setenv("EDGEFILTER_CRNN", str(own))
    _, found = islice(doctor.examine("mic", None, None), 2)
    assert (found.name, found.state) == ("model", "warning")
    assert str(own) in found.found and "EDGEFILTER_CRNN" in found.do


def test_pace_and_level_are_measured(plug):  # noqa: F811
    """An input whose clock is 2 % fast."""
    system = plug(VirtualDevice("microphone", "input", ppm=2e4))
    (heard,) = listen([input_port(None)], seconds=2.0)
    assert heard.pace == pytest.approx(1.02, abs=1e-3) and heard.overruns == 0
    assert heard.level_db == heard.peak_db == pytest.approx(20 * np.log10(0.25))
    assert [stream.running for stream in system.streams] == [False]


def test_devices_are_listed_where_no_output_exists(plug, no_server, capsys):  # noqa: F811
    """A reference needs an output; the list does not."""
    plug(VirtualDevice("USB microphone", "input"))
    assert main(["devices"]) == 0
    listed = capsys.readouterr().out.splitlines()
    why = "no sound device with an output was found: connect one, or check that the sound server runs ('edgefilter devices')"
    assert "USB microphone" in listed[0] and listed[-1].endswith(f"none ({why})")
