"""A result says from what it was made, the same on every machine, and no figure of it is lost."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from bench import results_writer
from edgefilter.engines import create
from edgefilter.errors import UsageError


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "here" / "val"
    (folder / "a").mkdir(parents=True)
    (folder / "a" / "one.txt").write_text("one")
    (folder / "two.txt").write_text("two")
    return folder


def test_digest_is_of_names_and_contents_and_not_of_the_place(data: Path, tmp_path: Path) -> None:
    found = results_writer.digest(data)
    assert found["files"] == 2 and found["bytes"] == 6
    by_hand = hashlib.sha256()
    for name, content in (("a/one.txt", b"one"), ("two.txt", b"two")):
        by_hand.update(f"{name}\0{len(content)}\0".encode() + hashlib.sha256(content).digest())
    assert found["sha256"] == by_hand.hexdigest()
    copy = shutil.copytree(data, tmp_path / "elsewhere")
    assert results_writer.digest(copy) == found
    (copy / "two.txt").rename(copy / "too.txt")
    assert results_writer.digest(copy)["sha256"] != found["sha256"]
    (copy / "too.txt").rename(copy / "two.txt")
    (copy / "two.txt").write_text("tow")
    assert results_writer.digest(copy)["sha256"] != found["sha256"]


def test_an_empty_folder_or_a_missing_model_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no file"):
        results_writer.stamp({"HUMAN": [tmp_path]})
    with pytest.raises(UsageError, match="cannot be read"):
        results_writer.stamp(models={"WHISPER": tmp_path / "model.bin"})


def test_stamp_and_pages_hold_no_folder_of_this_machine(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, output = tmp_path / "ct2" / "model.bin", tmp_path / "results" / "quality.v1"
    model.parent.mkdir()
    model.write_bytes(b"weights")
    arguments = ["--speech", str(data), "--whisper", str(model.parent), f"--cache={tmp_path}/kept", "--output", str(output), "--seed", "3"]
    monkeypatch.setattr("sys.argv", [str(tmp_path / "quality.py"), *arguments])
    made_with = results_writer.stamp({"HUMAN": [data]}, models={"WHISPER": model})
    wanted = "python -m quality --speech HUMAN/val --whisper WHISPER --cache=kept --output quality.v1 --seed 3"
    assert made_with["command"] == wanted
    assert made_with["models"]["WHISPER"]["sha256"] == hashlib.sha256(b"weights").hexdigest()
    page = results_writer.write(output, made_with, "Quality", "a page\n", {"rows": []})
    written = [output.with_name(f"quality.v1{suffix}").read_text(encoding="utf-8") for suffix in (".json", ".md")]
    assert written[1] == page and page.startswith(f"# Quality\n\n`{wanted}`\n") and page.endswith("\n\na page\n")
    assert made_with["data"][0]["sha256"][:12] in page and made_with["commit"][:12] in page
    assert not any(str(tmp_path) in text or str(Path.home()) in text for text in written)


def test_an_engine_with_a_network_brings_the_hash_of_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    path = create("crnn").model.path
    wanted = {path.name: hashlib.sha256(path.read_bytes()).hexdigest()}
    for names in (["ss", "crnn"], ["auto"]):
        assert {name: entry["sha256"] for name, entry in results_writer.stamp(engine_names=names)["models"].items()} == wanted
    assert results_writer.stamp(engine_names=["ss", "aec3"])["models"] == {}


def test_a_changed_tree_is_dirty_and_changed_results_are_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*arguments: str) -> None:
        names = ["-c", "user.name=n", "-c", "user.email=e@x"]
        subprocess.run(["git", "-C", str(tmp_path), *names, *arguments], check=True, capture_output=True)

    monkeypatch.setattr(results_writer, "ROOT", tmp_path)
    assert results_writer.revision() == ("unknown", True)
    (tmp_path / "bench/results").mkdir(parents=True)
    for name in ("code.py", "bench/results/q.json"):
        (tmp_path / name).write_text("1")
    git("init")
    git("add", ".")
    git("commit", "-m", "first")
    commit, dirty = results_writer.revision()
    assert len(commit) == 40 and not dirty
    (tmp_path / "bench/results/q.json").write_text("2")
    assert results_writer.revision() == (commit, False)
    (tmp_path / "code.py").write_text("2")
    assert results_writer.revision() == (commit, True)


def test_numbers_become_plain_and_what_is_not_finite_null() -> None:
    content = {"a": np.float32(0.5), "b": [np.nan, float("inf"), 1], "c": np.arange(2), "d": (np.int64(3), True, None, "x")}
    assert json.loads(results_writer.to_json(content)) == {"a": 0.5, "b": [None, None, 1], "c": [0, 1], "d": [3, True, None, "x"]}


def test_machine_tells_how_many_threads_were_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert results_writer.machine()["threads"] == "1"
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert "not limited" in results_writer.machine()["threads"]
