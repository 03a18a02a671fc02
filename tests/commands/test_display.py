"""What a person sees during a run."""

import re
import subprocess
import sys
import time

import numpy as np
import pytest
import soundfile

from edgefilter.commands import display
from edgefilter.session import Progress
from edgefilter.types import Block
from tests.diagnosis.robot_scene import profile, record, voice
from tests.program import argv

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


def test_a_countdown_is_drawn_on_a_terminal_once_a_second_and_is_one_line_elsewhere(monkeypatch, capsys):
    for terminal, told in (
        (True, ["now quiet, 2 s left", "now quiet, 1 s left", "now quiet, 0 s left"]),
        (False, ["now quiet"]),
    ):
        monkeypatch.setattr(sys.stderr, "isatty", lambda shown=terminal: shown, raising=False)
        show = display.countdown("now quiet")
        for left_s in (2.0, 1.5, 1.0, 0.4, 0.0):
            show(left_s)
        drawn = [part.strip() for part in re.split(r"[\r\n]", capsys.readouterr().err)]
        assert [part for at, part in enumerate(drawn) if part and part != drawn[at - 1]] == told


@pytest.mark.parametrize(("total", "told"), [(None, "2 s"), (160_000, "2 of 10 s")])
def test_a_recording_gets_progress_that_counts_seconds(monkeypatch, capsys, total, told):
    monkeypatch.setattr(display, "LINE_PERIOD_S", 0.05)

    class Recording:
        live = False

    Recording.total = total
    with display.display(Recording(), Ego(), quiet=False) as show:
        show(Progress(samples=32_000))
        time.sleep(0.5)
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"filtering: {told}")


def test_a_short_recording_is_filtered_without_a_word_of_progress(capsys):
    class Recording:
        live, total = False, 160_000

    with display.display(Recording(), Ego(), quiet=False) as show:
        show(Progress(samples=32_000))
    assert capsys.readouterr().err == ""


def test_the_legend_explains_each_part_of_the_status_line():
    progress = Progress(residual_db=-24.6)
    line = display.status_line(progress, STATS, {"microphone_overruns": 1}, 220)
    parts = {word for word in re.findall(r"[a-z]+", line) if word not in ("ms", "ppm", "d", "db")}
    explained = "\n".join(row[:20] for row in display.STATUS_LEGEND.splitlines())
    assert len(parts) == 11 and all(part in explained for part in parts), parts


def test_json_goes_to_a_file_or_to_standard_output(tmp_path, capsys):
    display.write_json({"a": 1}, str(tmp_path / "x.json"))
    assert (tmp_path / "x.json").read_text().split() == ["{", '"a":', "1", "}"]
    display.write_json({"b": 2}, "-")
    assert '"b": 2' in capsys.readouterr().out


def test_a_long_command_says_what_it_does_before_it_has_done_it_where_there_is_no_terminal(tmp_path):
    """A pipe gets a line at once, then one now and then; standard output has nothing of it."""
    x = voice(6.0)
    soundfile.write(tmp_path / "ref.wav", x, 16000, "FLOAT")
    soundfile.write(tmp_path / "mic.wav", record(x), 16000, "FLOAT")
    profile().save(tmp_path / "robot.npz")
    files = ["--profile", "robot.npz", "--recording", "mic.wav", "--reference", "ref.wav"]
    child = subprocess.Popen(
        argv("diagnose", *files),
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert "diagnosis" in child.stderr.readline()
        assert child.poll() is None, "said when all was over"
    finally:
        child.kill()
        out, _ = child.communicate()
    assert out == ""


def test_piped_output_is_there_line_by_line_and_not_when_the_program_ends():
    """What is printed stays where the process then dies without a word."""
    code = "import os; from edgefilter.cli import main; main(['devices', '--setup']); print('last'); os._exit(0)"
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert done.stdout.endswith("last\n")


def test_what_a_c_library_prints_is_kept_off_the_terminal_and_what_python_or_another_program_says_is_not():
    code = (
        "import ctypes, os, sys\n"
        "from edgefilter.commands.display import own_words_only\n"
        "c = ctypes.CDLL(None)\n"
        "library = lambda word: c.fputs(word, ctypes.c_void_p.in_dll(c, 'stderr'))\n"
        "with own_words_only():\n"
        "    library(b'noise'); print('python', file=sys.stderr, flush=True); os.system('echo program >&2')\n"
        "library(b'library')"
    )
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, check=True)
    assert done.stderr.split() == ["python", "program", "library"]


def test_progress_goes_on_being_said_while_one_step_lasts(capsys, monkeypatch):
    monkeypatch.setattr(display, "LINE_PERIOD_S", 0.05)
    with display.progress("diagnosis") as step:
        step("trying late_reverb")
        time.sleep(0.5)
    said = capsys.readouterr().err.splitlines()
    assert said[0].endswith("diagnosis") and len(said) > 3 and said[-1].endswith("diagnosis: trying late_reverb")
