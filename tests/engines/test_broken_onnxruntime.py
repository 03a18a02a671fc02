"""Where onnxruntime is broken, everything that needs no network goes on, and what was given up is said."""

import subprocess
import sys

import numpy as np
import pytest
import soundfile

BREAKS = {
    "ImportError": "ImportError('DLL load failed while importing onnxruntime_pybind11_state')",
    "OSError": "OSError('libgomp.so.1: cannot open shared object file')",
    "AttributeError": "AttributeError('_ARRAY_API not found')",
}


@pytest.fixture(params=BREAKS)
def program(request, tmp_path):
    """Runs the command line with an onnxruntime that cannot be imported."""
    (tmp_path / "broken/onnxruntime").mkdir(parents=True)
    (tmp_path / "broken/onnxruntime/__init__.py").write_text(f"raise {BREAKS[request.param]}\n")
    soundfile.write(tmp_path / "mic.wav", 0.01 * np.random.default_rng(0).standard_normal(8000), 16000)

    def run(*more):
        words = ["run", "--input", "mic.wav", "--output", "out.wav", "--quiet", *more]
        code = f"import sys; sys.path.insert(0, 'broken'); from edgefilter.cli import main; sys.exit(main({words!r}))"
        return subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)

    run.error = request.param
    return run


@pytest.mark.slow
def test_auto_steps_down_to_ss_and_says_why(program):
    done = program()
    assert done.returncode == 0, done.stderr
    assert (
        "engine ss (auto" in done.stderr
        and f"crnn cannot be used: onnxruntime cannot be loaded ({program.error}" in done.stderr
    )


def test_the_network_asked_for_by_name_is_one_line(program):
    done = program("--engine", "crnn")
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert "onnxruntime cannot be loaded" in done.stderr and "pip install" in done.stderr
