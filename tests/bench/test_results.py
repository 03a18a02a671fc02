"""A result says from what it was made, the same on every machine, and no figure of it is lost."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from bench import provenance, results
from edgefilter.engines import create
from edgefilter.errors import UsageError
from tests.bench.conftest import rows_of


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "here" / "val"
    (folder / "a").mkdir(parents=True)
    (folder / "a" / "one.txt").write_text("one")
    (folder / "two.txt").write_text("two")
    return folder


def test_digest_is_of_names_and_contents_and_not_of_the_place(data: Path, tmp_path: Path) -> None:
    found = results.digest(data)
    assert found["files"] == 2 and found["bytes"] == 6
    by_hand = hashlib.sha256()
    for name, content in (("a/one.txt", b"one"), ("two.txt", b"two")):
        by_hand.update(f"{name}\0{len(content)}\0".encode() + hashlib.sha256(content).digest())
    assert found["sha256"] == by_hand.hexdigest()
    copy = shutil.copytree(data, tmp_path / "elsewhere")
    assert results.digest(copy) == found
    (copy / "two.txt").rename(copy / "too.txt")
    assert results.digest(copy)["sha256"] != found["sha256"]
    (copy / "too.txt").rename(copy / "two.txt")
    (copy / "two.txt").write_text("tow")
    assert results.digest(copy)["sha256"] != found["sha256"]


def test_an_empty_folder_or_a_missing_model_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no file"):
        provenance.stamp({"HUMAN": [tmp_path]})
    with pytest.raises(UsageError, match="model.bin holds no file"):
        provenance.stamp(models={"WHISPER": tmp_path / "model.bin"})


def test_stamp_and_pages_hold_no_folder_of_this_machine(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, whisper, output = tmp_path / "best.pt", tmp_path / "ct2", tmp_path / "results" / "quality.v1"
    network.write_bytes(b"weights")
    whisper.mkdir()
    (whisper / "model.bin").write_bytes(b"words")
    arguments = [
        "--speech",
        str(data),
        "--whisper",
        str(whisper),
        f"--cache={tmp_path}/kept",
        "--output",
        str(output),
        "--seed",
        "3",
    ]
    monkeypatch.setattr("sys.argv", [str(tmp_path / "bench"), "evaluate", *arguments])
    made_with = provenance.stamp({"HUMAN": [data]}, models={"WHISPER": whisper, "best.pt": network, "other": None})
    wanted = "python -m bench evaluate --speech HUMAN/val --whisper WHISPER --cache=kept --output quality.v1 --seed 3"
    assert made_with["command"] == wanted
    assert set(made_with["models"]) == {"WHISPER", "best.pt"}
    assert made_with["models"]["best.pt"]["sha256"] == hashlib.sha256(b"weights").hexdigest()
    assert made_with["models"]["WHISPER"]["sha256"] == results.digest(whisper)["sha256"]
    shown = [results.table("one", "One", ["row", ("dB", 1)], [["a", 2.04]], "Above it.")]
    page = results.write(output, "part", "Quality", made_with, shown, notes="A note.", more=[1])
    written = [output.with_name(f"quality.v1{suffix}").read_text(encoding="utf-8") for suffix in (".json", ".md")]
    assert page.startswith(f"## Quality\n\n`{wanted}`\n") and page in written[1]
    assert page.endswith("A note.\n\n### One\n\nAbove it.\n\n| row | dB |\n| --- | --- |\n| a | 2.0 |")
    assert json.loads(written[0])["parts"]["part"]["more"] == [1]
    assert made_with["data"][0]["sha256"][:12] in page and made_with["commit"][:12] in page
    assert not any(str(tmp_path) in text or str(Path.home()) in text for text in written)


def test_an_engine_with_a_network_brings_the_hash_of_its_file() -> None:
    path = create("crnn").model.path
    wanted = {path.name: hashlib.sha256(path.read_bytes()).hexdigest()}
    for name in ("crnn", "crnn-uncalibrated", "crnn-uncalibrated-learning", "auto"):
        assert {
            key: results.digest(file)["sha256"] for key, file in provenance.models_of(["ss", name]).items()
        } == wanted
    assert provenance.models_of(["ss", "aec3"]) == {}


def test_a_part_that_is_made_again_leaves_the_others_alone(tmp_path: Path) -> None:
    made_with = provenance.stamp()
    output = tmp_path / "live"
    plots = [
        results.plot("curve", [results.panel("p", "s", "dB", {"a": ([0, 1], [1.0, None]), "b": ([0, 1], [2.0, 3.0])})])
    ]
    results.write(output, "one", "First", made_with, plots=plots)
    results.write(output, "two", "Second", made_with, [results.table("t", "T", ["x"], [[1]])])
    results.write(output, "two", "Second again", made_with)
    page = (tmp_path / "live.md").read_text()
    assert page.startswith("# Live\n\n## First\n") and "## Second again\n" in page and "### T" not in page
    assert "![curve](live_curve.png)" in page and (tmp_path / "live_curve.png").stat().st_size > 5000
    assert list(results.read(tmp_path / "live.json")["parts"]) == ["one", "two"]


def test_a_quoted_table_is_made_from_the_results(tmp_path: Path) -> None:
    rows = [["a", {"mean": 31.4, "low": 25.0, "high": 37.0}]]
    results.write(
        tmp_path / "devices", "devices", "D", provenance.stamp(), [results.table("six", "Six", ["row", ("%", 0)], rows)]
    )
    page = "before\n<!-- table: devices/six -->\nold\n<!-- end -->\nafter"
    made = results.quote(page, tmp_path)
    assert (
        made
        == "before\n<!-- table: devices/six -->\n| row | % |\n| --- | --- |\n| a | 31 [25, 37] |\n<!-- end -->\nafter"
    )
    assert results.quote(made, tmp_path) == made
    with pytest.raises(UsageError, match="no table 'seven' in bench/results/devices.json"):
        results.quote(page.replace("six", "seven"), tmp_path)


def test_the_tables_of_the_pages_are_those_of_the_results() -> None:
    for page in results.PAGES:
        text = page.read_text(encoding="utf-8")
        assert results.quote(text) == text, f"{page.name}: run python -m bench tables"


def test_a_changed_tree_is_dirty_and_changed_results_are_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*arguments: str) -> None:
        names = ["-c", "user.name=n", "-c", "user.email=e@x"]
        subprocess.run(["git", "-C", str(tmp_path), *names, *arguments], check=True, capture_output=True)

    monkeypatch.setattr(results, "ROOT", tmp_path)
    assert results.revision() == ("unknown", True)
    (tmp_path / "bench/results").mkdir(parents=True)
    for name in ("code.py", "bench/results/q.json"):
        (tmp_path / name).write_text("1")
    git("init")
    git("add", ".")
    git("commit", "-m", "first")
    commit, dirty = results.revision()
    assert len(commit) == 40 and not dirty
    (tmp_path / "bench/results/q.json").write_text("2")
    assert results.revision() == (commit, False)
    (tmp_path / "code.py").write_text("2")
    assert results.revision() == (commit, True)


def test_numbers_become_plain_and_what_is_not_finite_null() -> None:
    content = {
        "a": np.float32(0.5),
        "b": [np.nan, float("inf"), 1],
        "c": np.arange(2),
        "d": (np.int64(3), True, None, "x"),
    }
    assert json.loads(results.to_json(content)) == {
        "a": 0.5,
        "b": [None, None, 1],
        "c": [0, 1],
        "d": [3, True, None, "x"],
    }
    rows = [{"a": "[b\n{", "c": [1, {"d": 2}]}, {"a": "e", "f": 0.123456789}]
    text = results.to_json({"rows": results.columns(rows)})
    assert "[ 0.12346 ]" not in text and json.loads(text)["rows"]["values"][1] == ["e", None, 0.12346]
    assert rows_of(results.columns(rows[:1])) == rows[:1]


def test_machine_tells_how_many_threads_were_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert results.machine()["threads"] == "1"
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert "not limited" in results.machine()["threads"]
