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


@pytest.mark.slow
@pytest.mark.parametrize(("error", "raised"), BREAKS.items(), ids=BREAKS)
def test_auto_steps_down_to_ss_and_says_why_and_the_network_asked_for_by_name_is_one_line(error, raised, tmp_path):
    (tmp_path / "broken/onnxruntime").mkdir(parents=True)
    (tmp_path / "broken/onnxruntime/__init__.py").write_text(f"raise {raised}\n")
    soundfile.write(tmp_path / "mic.wav", 0.01 * np.random.default_rng(0).standard_normal(8000), 16000)
    words = ["run", "--input", "mic.wav", "--output", "out.wav", "--quiet"]
    code = "import sys; sys.path.insert(0, 'broken'); from edgefilter.cli import main"
    for each in ([*words, "--engine", "crnn"], words):
        code += f"; print('exit', main({each!r}), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    by_name, auto = done.stderr.split("exit 1\n")
    assert by_name.count("\n") == 1 and "onnxruntime cannot be loaded" in by_name and "pip install" in by_name
    assert auto.endswith("exit 0\n") and "engine ss (auto" in auto
    assert f"crnn cannot be used: onnxruntime cannot be loaded ({error}" in auto
