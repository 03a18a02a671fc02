"""`edgefilter doctor` on machines that lack something: each finding says what to do, and the exit code tells."""

import json
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from edgefilter.audio import measure, pulse
from edgefilter.audio.measure import Trial, listen
from edgefilter.audio.pairing import Inlet
from edgefilter.cli import main
from edgefilter.commands import doctor
from edgefilter.commands.doctor import Check
from edgefilter.errors import DeviceError, ModelError


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


def raises(error):
    def fail(*_):
        raise error

    return fail


def test_what_is_missing_is_found_and_the_rest_still_checked(monkeypatch):
    from edgefilter.audio import device

    monkeypatch.setattr(doctor, "create", raises(ModelError("model x is not the one: reinstall edgefilter")))
    monkeypatch.setattr(doctor, "allowed_cores", lambda: {0})
    monkeypatch.setattr(pulse, "names", lambda kind: [])
    monkeypatch.setattr(pulse, "default_name", lambda kind: "")
    monkeypatch.setattr(device, "_sounddevice", raises(DeviceError("live audio needs the PortAudio library")))
    found = {check.name: check for check in doctor.examine("mic", None, None)}
    assert {name for name, check in found.items() if check.state == "failed"} == {"model", "microphone", "reference"}
    assert {name for name, check in found.items() if check.state == "warning"} == {"cores", "sound server"}
    assert "reinstall" in found["model"].found and "PortAudio" in found["microphone"].found
    assert "allow another core" in found["cores"].do and "start PulseAudio" in found["sound server"].do
    assert found["engine"].state == "ok" and "crnn" in found["engine"].found


@pytest.mark.parametrize(
    ("pace", "level", "peak", "states", "words"),
    [
        (1.0005, -40.0, -20.0, ["ok", "ok"], "-40 dB"),
        (0.92, -40.0, -20.0, ["failed", "ok"], "loses samples"),
        (1.0, -120.0, -120.0, ["ok", "warning"], "unmute"),
        (1.0, -80.0, -60.0, ["ok", "warning"], "raise"),
        (1.0, -10.0, 0.0, ["ok", "warning"], "clipped"),
    ],
)
def test_clock_and_level_are_checked(pace, level, peak, states, words):
    heard = Trial(48_000, pace, level, peak, overruns=0)
    found = [doctor._clock("microphone", heard), doctor._level(heard)]
    assert [check.state for check in found] == states
    assert words in " ".join(check.found + check.do for check in found)


def test_another_model_than_the_package_s_is_said(monkeypatch):
    own = Path(__file__).parents[2] / "models/crnn_20ms_int8.onnx"
    monkeypatch.setenv("EDGEFILTER_CRNN", str(own))
    _, found = islice(doctor.examine("mic", None, None), 2)
    assert (found.name, found.state) == ("model", "warning")
    assert str(own) in found.found and "EDGEFILTER_CRNN" in found.do


def test_pace_and_level_are_measured(monkeypatch):
    """A port whose clock is 2 % fast, by a clock of the test's own."""
    now = [100.0]
    monkeypatch.setattr(measure, "clock", lambda: now[0])

    class Port:
        rate, opened, closed, wanted = 16_000, False, False, None

        def __init__(self):
            self.inlet, self.total = Inlet(64_000), 0.0

        def open(self):
            self.opened = True

        def check_alive(self, received, patience):
            due = int((now[0] - 100.0) * 1.02 * self.rate) - int(self.total)
            self.total += due
            self.inlet.receive(np.full(due, 0.1, np.float32))

        def take(self):
            return self.inlet.take()

        def close(self):
            self.closed = True

    def sleep(seconds):
        now[0] += seconds

    monkeypatch.setattr(measure, "pause", lambda: sleep(0.004))
    port = Port()
    (heard,) = listen([port], seconds=2.0)
    assert heard.pace == pytest.approx(1.02, abs=1e-3) and port.opened and port.closed
    assert heard.level_db == pytest.approx(-20.0, abs=0.1) and heard.overruns == 0


def test_devices_are_listed_where_no_output_exists(monkeypatch, capsys):
    """A reference needs an output; the list does not."""
    from edgefilter.audio import device

    microphone = {"index": 0, "inputs": 1, "outputs": 0, "rate": 48_000.0, "name": "USB microphone"}
    monkeypatch.setattr(device, "list_devices", lambda: [microphone])
    monkeypatch.setattr(device, "monitor_of", raises(DeviceError("no sound device with an output was found")))
    monkeypatch.setattr(pulse, "names", lambda kind: [])
    assert main(["devices"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert "USB microphone" in listed[0] and listed[-1].endswith("none (no sound device with an output was found)")
