"""Simulated recordings beside real ones, on two seconds of each."""

import json

import numpy as np
import pytest
import soundfile as sf

from bench.measure import simulated
from tests.export.speech import RATE, babble

SECONDS = 8


def test_pieces_of_both_kinds_are_measured_alike(tmp_path, monkeypatch):
    monkeypatch.setattr(simulated, "aecmos", lambda: None)
    monkeypatch.setattr(simulated, "PIECE_S", float(SECONDS))
    rng = np.random.default_rng(1)
    items, real = tmp_path / "items", tmp_path / "real"
    items.mkdir(), real.mkdir()
    reference, human = (babble(rng, SECONDS) for _ in range(2))
    robot = np.convolve(reference, [0.5, 0.2])[: reference.size]
    for number, (warm, left_db) in enumerate(((False, -20), (True, -3), (False, -10))):
        left = 10 ** (left_db / 20) * robot
        signals = {"mic": robot + human, "error": left + human, "reference": reference, "clean": human}
        packed = {name: np.round(32767 * x).astype(np.int16) for name, x in signals.items()}
        scales = {"scale": np.float32(1), "reference_scale": np.float32(1)}
        np.savez(items / f"{number:05d}.npz", about=json.dumps({"warm": warm}), **packed, **scales)
    sf.write(real / "a_lpb.wav", reference, RATE, "FLOAT")
    sf.write(real / "a_mic.wav", robot + 1e-4 * rng.standard_normal(robot.size), RATE, "FLOAT")
    arguments = ["--items", items, "--real", real, "--output", tmp_path / "out"]
    monkeypatch.setattr("sys.argv", ["simulated", *map(str, arguments)])
    assert simulated.main() == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert [row["erle_db"] for row in found["simulated"]] == pytest.approx([20.0, 10.0], abs=0.1)
    assert all(row["bursts_db"] == pytest.approx(0.0, abs=0.5) for row in found["simulated"])
    assert len(found["real"]) == 1 and found["real"][0]["erle_db"] > 15
    page = (tmp_path / "out.md").read_text()
    assert "simulated, 2 pieces" in page and "AECMOS" not in page.split("| --- |")[1]


def test_a_folder_without_items_is_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.txt").write_text("nothing")
    arguments = ["--items", tmp_path, "--real", tmp_path, "--output", tmp_path / "out"]
    monkeypatch.setattr("sys.argv", ["simulated", *map(str, arguments)])
    assert simulated.main() == 1
    assert "holds no items" in capsys.readouterr().err
