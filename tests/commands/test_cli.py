"""The command line as people use it, good input and every kind of bad one; in a process of its own where that matters."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import soundfile

from edgefilter.types import SAMPLE_RATE as RATE
from tests.program import edgefilter, here, one_line


@pytest.fixture
def speech(tmp_path):
    """A recording and its reference, 2 s of noise bursts at 16 kHz."""
    rng = np.random.default_rng(0)
    ref = 0.1 * rng.standard_normal(2 * RATE) * (np.sin(np.arange(2 * RATE) / 2000) > 0)
    mic = 0.5 * np.roll(ref, 800) + 0.001 * rng.standard_normal(ref.size)
    soundfile.write(tmp_path / "mic.wav", mic, RATE, "FLOAT")
    soundfile.write(tmp_path / "ref.wav", ref, RATE, "FLOAT")
    return tmp_path


def run(folder, *more, mic="mic.wav", engine="bypass", output="out.wav", program=here):
    return program("run", "--input", folder / mic, "--engine", engine, "--output", folder / output, *more)


def test_run_writes_as_many_samples_as_it_read_and_says_what_it_did(speech):
    result = run(speech, "--reference", speech / "ref.wav", "--json", speech / "stats.json", program=edgefilter)
    assert result.returncode == 0, result.stderr
    out, rate = soundfile.read(speech / "out.wav")
    mic, _ = soundfile.read(speech / "mic.wav")
    assert rate == RATE and out.shape == mic.shape
    np.testing.assert_allclose(out, mic, atol=2 / 32768)  # one step of 16-bit PCM, and its rounding
    stats = json.loads((speech / "stats.json").read_text())
    assert stats["samples_in"] == stats["samples_out"] == mic.size and stats["samples_lost"] == 0
    assert 0 < stats["real_time_factor"] and stats["latency_ms"] == 32.0 and stats["engine"] == "bypass"
    assert "filtered 2.0 s" in result.stderr


@pytest.mark.slow
def test_a_pipe_gives_the_same_samples_as_a_file(speech):
    mic, ref = (soundfile.read(speech / name, dtype="int16")[0] for name in ("mic.wav", "ref.wav"))
    for name, x in (("mic16.wav", mic), ("ref16.wav", ref)):
        soundfile.write(speech / name, x, RATE, "PCM_16")
    for engine in ("bypass", "linear", "ss"):
        piped = edgefilter(
            "run",
            "--input",
            "-",
            "--output",
            "-",
            "--engine",
            engine,
            input=np.stack((mic, ref), axis=1).tobytes(),
            text=False,
        )
        assert piped.returncode == 0, piped.stderr
        assert run(speech, "--reference", speech / "ref16.wav", mic="mic16.wav", engine=engine).returncode == 0
        assert np.array_equal(np.frombuffer(piped.stdout, "<i2"), soundfile.read(speech / "out.wav", dtype="int16")[0])


def test_a_recorded_run_again_gives_the_identical_output(speech):
    assert run(speech, "--reference", speech / "ref.wav", "--record", speech / "heard", engine="ss").returncode == 0
    heard = speech / "heard"
    again = run(speech, "--reference", heard / "reference.wav", mic="heard/mic.wav", engine="ss", output="again.wav")
    assert again.returncode == 0
    assert (speech / "again.wav").read_bytes() == (speech / "out.wav").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "--engine", "crm"], ["unknown engine 'crm'", "linear"]),
        (["run", "--engin", "ss"], ["--engin"]),
        (["run", "--seconds", "-3"], ["--seconds"]),
        (["run", "--engine", "paper-ss"], ["--profile"]),
        (["run", "--engine", "bypass", "--save-profile", "p.npz"], ["--save-profile", "(crnn, ss, linear)"]),
        (["fly"], ["fly"]),
    ],
)
def test_wrong_usage_is_one_line_and_exit_2(speech, arguments, words):
    files = ["--input", speech / "mic.wav", "--output", speech / "out.wav"] if arguments[:1] == ["run"] else []
    one_line(here(*arguments, *files), 2, *words)
    assert not (speech / "out.wav").exists()


@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("text.mp3", ["ends in '.mp3'", ".wav or .flac"]),
        ("out.xyz", ["out.xyz is no file", ".wav or .flac", "no device"]),
        ("there", ["is a folder", "there/human.wav"]),
    ],
)
def test_an_output_that_cannot_be_written_is_refused_before_anything_is_looked_at(speech, output, words, monkeypatch):
    """The first two were looked for among the sound devices, the third was said to end in ''."""
    (speech / "there").mkdir()
    monkeypatch.chdir(speech)
    one_line(here("run", "--input", "missing.wav", "--engine", "bypass", "--output", output), 2, *words)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_while_it_is_still_being_loaded_it_says_so_in_one_line(number):
    """It took a traceback of the import that was under way, and exit code -2."""
    process = subprocess.Popen(
        [sys.executable, "-m", "edgefilter", "devices"], stderr=subprocess.PIPE, stdout=subprocess.PIPE
    )
    maps, until = Path(f"/proc/{process.pid}/maps"), time.monotonic() + 30
    while "numpy" not in maps.read_text():  # in the midst of the imports
        assert time.monotonic() < until
    process.send_signal(number)
    assert process.communicate(timeout=60)[1] == b"edgefilter: interrupted\n" and process.returncode == 130


def test_the_program_begins_where_it_can_be_interrupted():
    (program,) = [each for each in entry_points(group="console_scripts") if each.name == "edgefilter"]
    assert program.value == "edgefilter.__main__:main"


@pytest.mark.parametrize(("given", "expected"), [({}, "1"), ({"OMP_NUM_THREADS": "2"}, "2")])
def test_the_program_computes_in_one_thread_unless_more_are_asked_for(given, expected):
    code = """if True:
        import os, sys, edgefilter.__main__ as program
        print("numpy" in sys.modules)
        sys.argv[1:] = ["--version"]
        try:
            program.main()
        except SystemExit:
            print(os.environ["OMP_NUM_THREADS"])"""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"} | given
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    loaded, *_, threads = done.stdout.split()
    assert loaded == "False" and threads == expected


def test_what_was_done_to_a_file_is_said(speech):
    soundfile.write(speech / "short.wav", np.full((100, 2), 0.1), 8000)
    result = run(speech, "--reference", speech / "short.wav")
    assert result.returncode == 0 and soundfile.info(speech / "out.wav").frames == 2 * RATE
    assert all(words in result.stderr for words in ("8000 Hz", "2 channels", "short"))


def test_files_that_cannot_be_used_are_one_line(speech):
    (speech / "p.npz").write_bytes(b"PK\x03\x04 broken")
    one_line(run(speech, "--profile", speech / "p.npz"), 1, "p.npz")
    one_line(run(speech, mic="missing.wav"), 1, "missing.wav", "exist")
    one_line(run(speech, output="no/such/folder/out.wav"), 1, "out.wav")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_a_valid_file_with_what_was_received(tmp_path, number):
    process = subprocess.Popen(
        [
            sys.executable,
            *"-m edgefilter.cli run --input - --output".split(),
            str(tmp_path / "out.wav"),
            "--engine",
            "bypass",
        ],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    sent = np.full((RATE, 2), 1000, "<i2")
    process.stdin.write(sent.tobytes())
    process.stdin.flush()
    while sum(file.stat().st_size for file in tmp_path.iterdir()) < RATE:
        time.sleep(0.1)
    time.sleep(0.5)  # the pipe stays open: the program waits for more when the signal comes
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert b"Traceback" not in error and process.returncode == 130, error
    out = soundfile.read(tmp_path / "out.wav", dtype="int16")[0]
    assert out.size == RATE and (out == 1000).all()
