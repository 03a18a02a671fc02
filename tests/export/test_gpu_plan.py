"""The plan for half an hour of a GPU, rehearsed on the processor with seconds of data."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf

from edgefilter.engines.crnn import Crnn
from export.onnx_export import export, load
from tests.export.speech import RATE, write_table

ROOT = Path(__file__).parents[2]


@pytest.fixture
def speech(tmp_path):
    folder = tmp_path / "speech"
    for name in ("human/train", "human/val", "robot/train", "robot/val"):
        write_table(folder / name, ("a",))
    (folder / "noise").mkdir()
    sf.write(folder / "noise" / "hiss.wav", 0.01 * np.random.default_rng(0).standard_normal(RATE), RATE)
    return folder


def plan(step, speech, tmp_path, **more):
    places = {"SPEECH": str(speech), "DATA": str(tmp_path / "data"), "OUT": str(tmp_path / "out")}
    return subprocess.run(
        ["bash", "export/gpu_plan.sh", *step],
        cwd=ROOT,
        env=os.environ | places | {"PYTHON": sys.executable, "QUICK": "1"} | more,
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_the_plan_runs_from_speech_to_small_files(speech, tmp_path):
    start = tmp_path / "out" / "large.pt"
    for step, more in (("simulate", {}), ("large", {}), ("edge", {"START": str(start)})):
        done = plan([step], speech, tmp_path, **more)
        assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "data" / "train").glob("*.npz"))) == 3
    out = tmp_path / "out"
    assert sorted(path.name for path in out.iterdir()) == ["edge.jsonl", "edge.pt", "large.jsonl", "large.pt"]
    export(load(out / "edge.pt"), tmp_path / "edge.onnx")
    training = Crnn(tmp_path / "edge.onnx").model.training
    assert training["items"] == 3 and len(training["stages"]) == 2  # from the weights that were given
    done = plan([], speech, tmp_path)
    assert done.returncode == 2 and "SPEECH=DIR" in done.stdout
