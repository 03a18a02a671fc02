"""What a person sees during a run."""

import sys

import pytest

from edgefilter.commands import display
from edgefilter.session import Progress


def test_the_meter_shows_time_levels_and_losses():
    line = display.meter_line(Progress(samples=16_000 * 83, lost=7, mic_db=-30.0, ref_db=-120.0, out_db=0.0))
    assert line.startswith("01:23.0  mic #####.....  -30 dB")
    assert "robot .......... -120 dB" in line and "out ##########    0 dB" in line and line.rstrip().endswith("lost 7")


class Live:
    live, total = True, None


def test_the_meter_is_drawn_on_a_terminal_and_nowhere_else(monkeypatch, capsys):
    for terminal in (True, False):
        monkeypatch.setattr(sys.stderr, "isatty", lambda shown=terminal: shown, raising=False)
        with display.display(Live(), quiet=False) as show:
            show(Progress(samples=16_000))
        said = capsys.readouterr().err
        assert ("00:01.0" in said) == terminal
    with display.display(Live(), quiet=True) as show:
        show(Progress(samples=16_000))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("total", [None, 160_000])
def test_a_recording_gets_a_bar_that_counts_seconds(monkeypatch, total):
    counted = []
    monkeypatch.setattr(display.tqdm, "update", lambda bar, n: counted.append(n))

    class Recording:
        live = False

    Recording.total = total
    with display.display(Recording(), quiet=False) as show:
        show(Progress(samples=32_000))
    assert sum(counted) == pytest.approx(2.0)  # seconds; exact but for floats


def test_json_goes_to_a_file_or_to_standard_output(tmp_path, capsys):
    display.write_json({"a": 1}, str(tmp_path / "x.json"))
    assert (tmp_path / "x.json").read_text().split() == ["{", '"a":', "1", "}"]
    display.write_json({"b": 2}, "-")
    assert '"b": 2' in capsys.readouterr().out
