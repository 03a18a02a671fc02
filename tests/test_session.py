"""What a run accounts for, on every system."""

import json
import subprocess
import sys

import numpy as np
import pytest
import soundfile


@pytest.mark.slow
def test_every_command_starts_where_there_is_no_resource_module(tmp_path):
    """As on Windows."""
    soundfile.write(tmp_path / "mic.wav", np.full(4000, 0.1), 16000)
    words = ["run", "--input", "mic.wav", "--engine", "bypass", "--output", "out.wav", "--json", "-", "--quiet"]
    code = (
        "import sys; sys.modules['resource'] = None\nfrom importlib import import_module\nfrom pathlib import Path\n"
        "from edgefilter.cli import main\nimport_module('edgefilter.filter.timing').STATUS = Path('nowhere')\n"
        "[import_module(f'edgefilter.commands.{name}') for name in 'add calibrate compare demo devices"
        f" diagnose profile remove'.split()]\nsys.exit(main({words!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["peak_memory_mb"] is None
