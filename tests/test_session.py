"""What a run accounts for, on every system."""

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

from edgefilter import session


@pytest.mark.slow
def test_every_command_starts_where_there_is_no_resource_module(tmp_path):
    """As on Windows."""
    soundfile.write(tmp_path / "mic.wav", np.full(4000, 0.1), 16000)
    words = ["run", "--input", "mic.wav", "--engine", "bypass", "--output", "out.wav", "--json", "-", "--quiet"]
    code = (
        "import sys; sys.modules['resource'] = None\nfrom importlib import import_module\nfrom edgefilter.cli import"
        " main\n[import_module(f'edgefilter.commands.{name}') for name in 'add calibrate compare demo devices"
        f" diagnose profile remove'.split()]\nsys.exit(main({words!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["peak_memory_mb"] is None


@pytest.mark.parametrize(("system", "unit"), [("linux", 1024), ("darwin", 1024**2), ("freebsd14", 1024)])
def test_peak_memory_is_not_a_thousand_times_too_much_where_the_system_counts_bytes(monkeypatch, system, unit):
    counted = SimpleNamespace(RUSAGE_SELF=0, getrusage=lambda who: SimpleNamespace(ru_maxrss=75 * unit))
    monkeypatch.setattr(session, "resource", counted)
    monkeypatch.setattr(sys, "platform", system)
    assert session.peak_memory_mb() == 75.0


def test_peak_memory_here_is_that_of_a_python_with_numpy():
    assert 10 < session.peak_memory_mb() < 100_000
