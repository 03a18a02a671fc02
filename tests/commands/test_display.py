"""What a person sees during a run."""

import sys

import numpy as np
import pytest

from edgefilter.commands import display
from edgefilter.session import Progress
from edgefilter.types import Block

STATS = {
    "engine": "crnn",
    "alignment": {"delay_samples": 690.0, "ppm": 12.3},
    "learning": {"learned": 2},
    "deadline": {"missed_deadlines": 5},
}


def test_the_status_line_says_how_it_goes_and_fits_the_terminal():
    progress = Progress(samples=16_000 * 83, lost=7, mic_db=-30.0, ref_db=-120.0, out_db=0.0)
    progress.residual_db, progress.load = -24.6, 0.234
    source = {"lost": 7, "microphone_overruns": 1, "reference_overruns": 2}
    line = display.status_line(progress, STATS, source, 220)
    assert line.startswith("01:23.0  mic #####.....  -30 dB") and len(line) == 220
    assert "robot .......... -120 dB" in line and "out ##########    0 dB" in line
    assert line.rstrip().endswith(
        "crnn 23 %  late 5  lost 7  overruns 3  residual -25 dB  lag 43.1 ms  drift +12 ppm  learned 2"
    )
    narrow = display.status_line(progress, STATS, source, 79)
    assert len(narrow) == 79 and narrow.startswith(
        "01:23.0  mic -30 robot -120 out 0 dB  crnn 23 %  late 5  lost 7  over"
    )
    bare = display.status_line(Progress(), {**dict.fromkeys(STATS), "engine": "bypass"}, {}, 220)
    assert bare.rstrip().endswith("bypass 0 %  late 0  lost 0  overruns 0")


def test_residual_and_load_follow_the_last_second():
    progress, second = Progress(), np.full(16_000, 0.1, np.float32)
    for _ in range(8):
        progress.note(Block(second, second, 0, 3), 0.1 * second, human=False, process_s=0.25)
    assert progress.residual_db == pytest.approx(-20.0, abs=0.1) and progress.load == pytest.approx(0.25, abs=0.01)
    progress.note(Block(second, second, 0), second, human=True, process_s=0.25)
    progress.note(Block(second, 0 * second, 0), second, human=False, process_s=0.25)
    assert progress.residual_db == pytest.approx(-20.0, abs=0.1)  # nothing is said of a human, or of a silent robot
    assert (progress.samples, progress.lost) == (160_000, 24)


class Live:
    live, total = True, None

    def stats(self):
        return {}


class Ego:
    def stats(self):
        return STATS


def test_the_status_line_is_drawn_on_a_terminal_and_nowhere_else(monkeypatch, capsys):
    for terminal in (True, False):
        monkeypatch.setattr(sys.stderr, "isatty", lambda shown=terminal: shown, raising=False)
        with display.display(Live(), Ego(), quiet=False) as show:
            show(Progress(samples=16_000))
        said = capsys.readouterr().err
        assert ("00:01.0" in said) == terminal
    with display.display(Live(), Ego(), quiet=True) as show:
        show(Progress(samples=16_000))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("total", [None, 160_000])
def test_a_recording_gets_a_bar_that_counts_seconds(monkeypatch, total):
    counted = []
    monkeypatch.setattr(display.tqdm, "update", lambda bar, n: counted.append(n))

    class Recording:
        live = False

    Recording.total = total
    with display.display(Recording(), Ego(), quiet=False) as show:
        show(Progress(samples=32_000))
    assert sum(counted) == pytest.approx(2.0)  # seconds; exact but for floats


def test_json_goes_to_a_file_or_to_standard_output(tmp_path, capsys):
    display.write_json({"a": 1}, str(tmp_path / "x.json"))
    assert (tmp_path / "x.json").read_text().split() == ["{", '"a":', "1", "}"]
    display.write_json({"b": 2}, "-")
    assert '"b": 2' in capsys.readouterr().out
