"""models/MODELS.md and the metadata inside the model files say the same of how a network was trained."""

from __future__ import annotations

import functools
import json
import re
from itertools import takewhile
from pathlib import Path

import onnx
import pytest

from tests.program import ROOT

SHIPPED = sorted((*(ROOT / "models").glob("*.onnx"), *(ROOT / "bench/models").glob("*.onnx")))
FOR_TESTS = sorted((ROOT / "tests" / "data").glob("*.onnx"))


@functools.cache
def metadata(path: Path) -> dict[str, str]:
    return {entry.key: entry.value for entry in onnx.load(path).metadata_props}


def page() -> dict[str, dict[str, str]]:
    """The rows of the page's first table by file, cells by column."""
    lines = (ROOT / "models" / "MODELS.md").read_text(encoding="utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("| file |"))
    table = takewhile(lambda line: line.startswith("|"), lines[start:])
    head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in table)
    return {row[0].split(",")[0]: dict(zip(head, row, strict=True)) for row in rows}


def test_every_file_has_a_row_and_every_row_a_file() -> None:
    assert len(SHIPPED) >= 6
    assert sorted(page()) == sorted(path.name for path in SHIPPED)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_steps_seed_items_and_size_are_those_of_the_file(path: Path) -> None:
    row, said = page()[path.name], json.loads(metadata(path)["training"])
    seeds = said["seed"] if isinstance(said["seed"], list) else [said["seed"]]
    assert row["steps"] == str(said["step"])
    assert row["seed"] == ", ".join(map(str, seeds))
    assert row["items"] == str(said["items"])
    assert row["file"] == f"{path.name}, {path.stat().st_size / 1e6:.1f} MB"


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_validation_figures_are_those_of_the_file(path: Path) -> None:
    cell, said = page()[path.name]["validation SI-SDR, dB"], json.loads(metadata(path)["figures"])
    if cell.startswith("as "):
        cell = page()[cell.removeprefix("as ")]["validation SI-SDR, dB"]
    known = [said["si_sdr_db"], said.get("si_sdr_error_db", said.get("si_sdr_mic_db"))]
    found = re.findall(r"-?\d+\.\d", cell)
    assert found == [f"{value:.1f}" for value in known[: len(found)]] and found


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_stages_add_up_to_the_whole(path: Path) -> None:
    said = json.loads(metadata(path)["training"])
    stages = said.get("stages", [{"steps": said["step"], "seed": said["seed"], "items": said["items"]}])
    assert sum(stage["steps"] for stage in stages) == said["step"]
    assert [stage["seed"] for stage in stages] == (said["seed"] if "stages" in said else [said["seed"]])
    assert stages[-1]["items"] == said["items"]


def test_variants_of_a_network_say_the_same_of_its_training() -> None:
    said = {path.name: metadata(path) for path in SHIPPED}
    assert said["crnn.onnx"]["training"] == said["crnn_int8.onnx"]["training"]
    assert said["crnn.onnx"]["figures"] == said["crnn_int8.onnx"]["figures"]


def test_networks_for_tests_say_that_nothing_was_trained() -> None:
    assert len(FOR_TESTS) == 2
    for said in map(metadata, FOR_TESTS):
        assert json.loads(said["training"]) == {"data": "none: random weights", "seed": 0}
        assert json.loads(said["figures"]) == {}
