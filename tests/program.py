"""The command line, in this process or in one of its own, which takes half a second to begin; and the bundled sounds."""

import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import soundfile

from edgefilter.cli import main

ROOT = Path(__file__).parents[1]
DEMO = ROOT / "edgefilter/demo_data"
CALIBRATION = ROOT / "tests/data/demo_calibration"


def demo(*names):
    """Bundled sounds, each (n,) float32."""
    return [soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0] for name in names]


def here(*words):
    """What subprocess.run would give."""
    out, error = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        code = main([str(word) for word in words])
    return subprocess.CompletedProcess(words, code, out.getvalue(), error.getvalue())


def argv(*words):
    return [sys.executable, "-m", "edgefilter.cli", *map(str, words)]


def edgefilter(*words, **options):
    """The program in a process of its own."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": "input" not in options, "timeout": 120}
    return subprocess.run(argv(*words), **{**streams, **options})


def one_line(result, code, *words):
    """The run failed with this exit code and one line that holds all words and no traceback."""
    error = result.stderr if isinstance(result.stderr, str) else result.stderr.decode()
    lines = [line for line in error.strip().splitlines() if line.startswith("edgefilter:")]
    assert result.returncode == code, error
    assert len(lines) == 1 and "Traceback" not in error, error
    for word in words:
        assert word in lines[0], lines[0]
