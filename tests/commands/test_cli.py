"""The command line as people use it, good input and every kind of bad one; in a process of its own where that matters."""

import json
import resource
import signal
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import soundfile

from tests.program import edgefilter, here, one_line

RATE = 16000


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


def test_other_rates_and_channels_are_converted_and_said_so(speech):
    rng = np.random.default_rng(1)
    for rate, channels in ((8000, 1), (44100, 2), (48000, 1)):
        soundfile.write(speech / "other.flac", 0.1 * rng.standard_normal((rate, channels)), rate)
        result = run(speech, mic="other.flac")
        assert result.returncode == 0 and str(rate) in result.stderr
        assert (
            soundfile.info(speech / "out.wav").frames == RATE and soundfile.info(speech / "out.wav").samplerate == RATE
        )


def test_a_recorded_run_again_gives_the_identical_output(speech):
    assert run(speech, "--reference", speech / "ref.wav", "--record", speech / "heard", engine="ss").returncode == 0
    heard = speech / "heard"
    again = run(speech, "--reference", heard / "reference.wav", mic="heard/mic.wav", engine="ss", output="again.wav")
    assert again.returncode == 0
    assert (speech / "again.wav").read_bytes() == (speech / "out.wav").read_bytes()


def make_bad_files(folder):
    (folder / "empty.wav").write_bytes(b"")
    (folder / "text.wav").write_text("this is not audio")
    (folder / "folder.wav").mkdir()
    soundfile.write(folder / "zero.wav", np.zeros(0), RATE)
    bad = np.zeros(1000, np.float32)
    bad[345] = np.nan
    soundfile.write(folder / "nan.wav", bad, RATE, "FLOAT")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing.wav", ["missing.wav", "exist"]),
        ("empty.wav", ["empty.wav", "empty"]),
        ("zero.wav", ["zero.wav", "0 samples"]),
        ("folder.wav", ["folder.wav", "folder"]),
        ("text.wav", ["text.wav"]),
        ("nan.wav", ["nan.wav", "345"]),
    ],
)
def test_an_unusable_recording_is_one_line(speech, name, words):
    make_bad_files(speech)
    one_line(run(speech, mic=name), 1, *words)


def test_a_recording_of_one_sample_gives_one_sample(speech):
    soundfile.write(speech / "one.wav", np.full(1, 0.25), RATE)
    assert run(speech, mic="one.wav", engine="ss").returncode == 0
    assert soundfile.info(speech / "out.wav").frames == 1


def test_a_short_reference_is_padded_and_a_silent_one_is_said(speech):
    soundfile.write(speech / "short.wav", np.full(100, 0.1), RATE)
    soundfile.write(speech / "silent.wav", np.zeros(2 * RATE), RATE)
    short = run(speech, "--reference", speech / "short.wav")
    assert short.returncode == 0 and "short" in short.stderr
    assert soundfile.info(speech / "out.wav").frames == 2 * RATE
    silent = run(speech, "--reference", speech / "silent.wav")
    assert silent.returncode == 0 and "silent" in silent.stderr


def test_an_output_that_cannot_be_written_is_one_line(speech):
    one_line(run(speech, output="no/such/folder/out.wav"), 1, "out.wav")
    one_line(run(speech, output="out.xyz/out"), 2, ".wav")
    (speech / "text.mp3").write_text("")
    one_line(run(speech, output="text.mp3"), 2, ".wav", ".flac")


def test_a_full_disk_is_one_line_and_leaves_a_valid_file(speech):
    limit = 20_000

    def small_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    result = edgefilter(
        "run",
        "--input",
        speech / "mic.wav",
        "--engine",
        "bypass",
        "--output",
        speech / "out.wav",
        preexec_fn=small_disk,
    )
    one_line(result, 1, "out.wav", "File too large")
    out, mic = soundfile.read(speech / "out.wav")[0], soundfile.read(speech / "mic.wav")[0]
    assert 1000 < out.size < mic.size
    np.testing.assert_allclose(out, mic[: out.size], atol=2 / 32768)  # one step of 16-bit PCM, and its rounding


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


def test_output_over_an_input_is_refused(speech):
    before = (speech / "mic.wav").read_bytes()
    one_line(run(speech, output="mic.wav", program=edgefilter), 2, "overwritten")
    assert (speech / "mic.wav").read_bytes() == before


@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("out.m4a", ["ends in '.m4a'", ".wav or .flac"]),
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


def test_a_damaged_profile_is_one_line(speech):
    (speech / "p.npz").write_bytes(b"PK\x03\x04 broken")
    one_line(run(speech, "--profile", speech / "p.npz"), 1, "p.npz")


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
