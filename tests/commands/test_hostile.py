"""What users type and pipe by mistake: one line, the right exit code, nothing half done."""

import contextlib
import fcntl
import signal
import subprocess
import sys
import termios
import threading
import time

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from edgefilter.commands import doctor
from edgefilter.errors import ModelError
from tests.diagnosis.robot_scene import profile, record, voice
from tests.program import DEMO, argv, edgefilter, here


def one_line(done, code, *expected):
    assert done.returncode == code, done.stderr
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("edgefilter: "), done.stderr
    for words in expected:
        assert words in done.stderr, done.stderr


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with a recording and a profile."""
    monkeypatch.chdir(tmp_path)
    soundfile.write(tmp_path / "mic.wav", np.full(1600, 0.1), 16000)
    profile().save(tmp_path / "p.npz")
    return tmp_path


RUN = ("run", "--input", "mic.wav", "--engine", "bypass", "--output", "out.wav")


@pytest.mark.parametrize(
    "option", ["--json", "--profile", "--reference", "--model", "--record", "--save-profile", "--effects"]
)
def test_an_empty_name_as_an_unset_shell_variable_gives_is_not_taken_for_no_option(folder, option):
    one_line(here(*RUN, option, ""), 2, option, "is not the name of a file")
    assert not (folder / "out.wav").exists()


@pytest.mark.parametrize("value", ["nan", "inf", "1e5", "3", "-500", "loud", ""])
def test_a_level_that_no_sweep_can_have_is_refused(folder, value):
    one_line(
        here("calibrate", "--live", "--output", "new.npz", "--level-db", value),
        2,
        "--level-db",
        "from -90 to 0 dB",
    )


@pytest.mark.parametrize("value", ["abc", "", "nan", "0", "1e9"])
def test_a_number_that_is_none_is_said_in_words_of_the_user(folder, value):
    done = here(*RUN, "--seconds", value)
    one_line(done, 2, "--seconds", f"'{value}' is not a number above 0")
    assert "_positive" not in done.stderr


@pytest.mark.parametrize("level", [1e30, -3e38])
@pytest.mark.parametrize("command", ["run", "compare"])
def test_samples_far_beyond_full_scale_are_refused_with_their_value(folder, command, level):
    soundfile.write(folder / "big.wav", np.full(48000, level), 16000, "FLOAT")
    named = {"run": ("--input", "--output", "o.wav"), "compare": ("--recording", "--profile", "p.npz")}[command]
    one_line(
        here(command, named[0], "big.wav", "--reference", "mic.wav", *named[1:]),
        1,
        "big.wav",
        f"{level:g}",
        "full scale of 1",
    )
    assert not (folder / "o.wav").exists()


@pytest.mark.parametrize(("where", "why"), [("mic.wav", "no folder"), ("mic.wav/below", "no folder")])
def test_a_folder_that_cannot_be_made_leaves_the_output_of_an_earlier_run_alone(folder, where, why):
    (folder / "out.wav").write_bytes(b"of an earlier run")
    (folder / "other").write_text("a file")
    one_line(here(*RUN, "--record", where.replace("mic.wav", "other")), 1, "--record", why)
    one_line(here("demo", "--output", where), 1, "--output", why)
    assert (folder / "out.wav").read_bytes() == b"of an earlier run"


@pytest.mark.slow
def test_a_reader_that_goes_away_ends_the_program_without_a_traceback(folder):
    for words in (("profile", "show", "p.npz"), ("profile", "show", "p.npz", "--json", "-")):
        child = subprocess.Popen(
            argv(*words),
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        child.stdout.close()
        assert child.stderr.read() == "" and child.wait(60) == 1


def test_a_full_disk_behind_standard_output_is_one_line(folder):
    with open("/dev/full", "w") as full:
        one_line(edgefilter("profile", "show", "p.npz", stdout=full), 1, "No space left on device")


def test_a_name_that_the_terminal_cannot_show_does_not_stop_the_program(folder, monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    made = ("remove", "playback_gain", "--profile", "with.npz", "--output", "größer.npz")
    profile().with_echo(profile().echo.with_effect("playback_gain", {"gain_db": 1.0})).save(folder / "with.npz")
    done = edgefilter(*made)
    assert done.returncode == 0 and "gr\\xf6\\xdfer.npz" in done.stdout and (folder / "größer.npz").exists(), (
        done.stderr
    )


@pytest.mark.slow
def test_a_file_name_that_is_no_text_does_not_stop_the_report(tmp_path):
    name = b"\xff.wav"
    x = voice(3.0)
    soundfile.write(tmp_path / "ref.wav", x, 16000, "FLOAT")
    soundfile.write(tmp_path / "mic.wav", record(x, profile().echo), 16000, "FLOAT")
    (tmp_path / "mic.wav").rename(tmp_path / name.decode(errors="surrogateescape"))
    profile().save(tmp_path / "p.npz")
    words = [
        b"compare",
        b"--profile",
        b"p.npz",
        b"--recording",
        name,
        b"--reference",
        b"ref.wav",
        b"--report",
        b"r.html",
    ]
    done = subprocess.run(
        [sys.executable.encode(), b"-m", b"edgefilter.cli", *words], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "\\udcff.wav" in (tmp_path / "r.html").read_text()


def test_a_json_file_that_fails_does_not_cost_the_adapted_profile(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x = voice(2.0)
    soundfile.write(tmp_path / "ref.wav", x, 16000, "FLOAT")
    profile().save(tmp_path / "p.npz")
    words = "run --input ref.wav --reference ref2.wav --profile p.npz --engine linear --output o.wav --quiet".split()
    soundfile.write(tmp_path / "ref2.wav", x, 16000, "FLOAT")
    done = here(*words, "--save-profile", "new.npz", "--json", "/dev/full")
    assert done.returncode == 1 and "No space left" in done.stderr and (tmp_path / "new.npz").exists()


def test_the_effects_that_became_part_of_the_adapted_path_are_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x = voice(2.0)
    soundfile.write(tmp_path / "ref.wav", x, 16000, "FLOAT")
    echo = profile().echo.with_effect("bandlimit", {"cutoff_hz": 4000.0}).with_effect("playback_gain", {"gain_db": 1.0})
    profile().with_echo(echo).save(tmp_path / "p.npz")
    words = "run --input ref.wav --profile p.npz --engine linear --output o.wav --save-profile new.npz".split()
    done = here(*words)
    assert (
        done.returncode == 0
        and "the adapted path is in new.npz; bandlimit is part of it now and no longer listed" in done.stderr
    ), done.stderr


def feed(pipe, data):
    with contextlib.suppress(OSError):
        pipe.write(data)
        pipe.flush()


def wait_until_full(pipe):
    """Until a pipe that nobody reads takes no more."""
    before, end = -1, time.monotonic() + 60
    while time.monotonic() < end:
        held = int.from_bytes(fcntl.ioctl(pipe, termios.FIONREAD, bytes(4)), sys.byteorder)
        if held == before > 0:
            return
        before = held
        time.sleep(0.5)
    raise AssertionError("nothing came out")


@pytest.mark.slow
def test_a_second_signal_ends_a_run_whose_reader_does_not_read(folder):
    child = subprocess.Popen(
        argv(*"run --input - --output - --engine bypass --quiet".split()),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        # half as much comes out: more than the pipe behind it holds, so that it waits once this is swallowed
        threading.Thread(target=feed, args=(child.stdin, bytes(1 << 20)), daemon=True).start()
        wait_until_full(child.stdout)
        child.terminate()
        time.sleep(1.0)
        assert child.poll() is None, "it waits for its reader"
        child.terminate()
        assert child.wait(20) == 130 and b"interrupted" in child.stderr.read()
    finally:
        child.kill()
        child.wait()


def test_an_interrupt_counts_also_where_a_library_makes_an_import_error_of_it(monkeypatch, capsys):
    def swallow(args):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as interrupt:
            raise ModelError("initialization failed") from interrupt

    monkeypatch.setattr(doctor, "main", swallow)
    assert main(["doctor"]) == 130 and capsys.readouterr().err == "edgefilter: interrupted\n"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("command", ["diagnose", "passport", "demo", "doctor"])
def test_a_signal_ends_each_command_with_one_line_also_where_it_comes_twice(tmp_path, command, number):
    """timeout(1) signals a program and its group."""
    robot = DEMO / "hidden/one"
    alone = ("--recording", robot / "mic.flac", "--reference", robot / "reference.flac")
    words = {"diagnose": alone, "passport": alone, "demo": ("--hidden", "--output", tmp_path), "doctor": ()}[command]
    child = subprocess.Popen(
        [sys.executable, "-u", "-m", "edgefilter.cli", command, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        child.stdout.readline()  # it has begun
        child.send_signal(number)
        child.send_signal(number)
        said = child.communicate(timeout=20)[0].splitlines()
    finally:
        child.kill()
        child.wait()
    assert child.returncode == 130 and said[-1] == "edgefilter: interrupted", said
    assert not [line for line in said if "Traceback" in line], said
    for file in tmp_path.rglob("*.*"):
        assert soundfile.info(file).frames if file.suffix == ".wav" else file.suffix == ".npz", file
