"""Named pipes: as input and output of a run they are what standard input and output are, elsewhere one line says no."""

import os
import subprocess
import threading

import numpy as np
import pytest
import soundfile

from tests.program import ROOT, argv

STEREO = np.random.default_rng(0).integers(-9000, 9000, (4000, 2)).astype("<i2")


@pytest.fixture
def pipes(tmp_path):
    for name in ("in.wav", "out.wav"):
        os.mkfifo(tmp_path / name)
    return tmp_path


def run(folder, *words):
    return subprocess.run(
        argv(*words),
        cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip


def test_a_run_reads_and_writes_named_pipes_as_it_does_standard_input_and_output(pipes):
    got = []
    threads = [
        threading.Thread(target=lambda: (pipes / "in.wav").write_bytes(STEREO.tobytes()), daemon=True),
        threading.Thread(target=lambda: got.append((pipes / "out.wav").read_bytes()), daemon=True),
    ]
    for thread in threads:
        thread.start()
    done = run(pipes, "run", "--input", "in.wav", "--output", "out.wav", "--engine", "bypass")
    assert done.returncode == 0, done.stderr
    threads[1].join(10)
    np.testing.assert_array_equal(np.frombuffer(got[0], "<i2"), STEREO[:, 0])


def test_a_wav_file_in_a_pipe_of_raw_samples_is_one_line(pipes):
    soundfile.write(pipes / "x.wav", STEREO, 16000)
    header = (pipes / "x.wav").read_bytes()
    threading.Thread(target=lambda: (pipes / "in.wav").write_bytes(header), daemon=True).start()
    done = run(pipes, "run", "--input", "in.wav", "--output", "human.wav", "--engine", "bypass", "--quiet")
    assert (
        done.returncode == 1
        and "in.wav begins with the header of an audio file (b'RIFF'), expected raw s16le" in done.stderr
    )
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--input", "x.wav", "--reference", "in.wav", "--output", "human.wav"],
        ["compare", "--recording", "in.wav", "--reference", "x.wav"],
        ["calibrate", "--excitation", "out.wav"],
    ],
)
def test_a_pipe_where_a_file_is_needed_is_one_line_and_nothing_waits_for_it(pipes, words):
    soundfile.write(pipes / "x.wav", STEREO, 16000)
    done = run(pipes, *words)
    assert done.returncode == 1 and "is a pipe, expected a file" in done.stderr and done.stderr.count("\n") == 1
