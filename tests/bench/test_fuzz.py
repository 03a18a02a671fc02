"""The fuzzer itself: every loader has files to start from, a few damaged ones of each are refused or taken, and a find is one."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from bench import __main__ as bench
from bench import fuzz
from bench.fuzz.targets import TARGETS
from edgefilter.errors import UsageError

INPUTS = 12


def run(output: Path, *arguments: object) -> tuple[int, dict]:
    """The exit code, and what was written."""
    code = bench.main(["fuzz", "--output", str(output), *map(str, arguments)])
    return code, json.loads(output.with_suffix(".json").read_text())["parts"]["fuzz"]


@pytest.mark.slow
@pytest.mark.parametrize("loader", [target.name for target in TARGETS])
def test_a_few_damaged_files_of_each_loader_keep_every_promise(loader: str, tmp_path: Path) -> None:
    code, found = run(tmp_path / "fuzz", "--inputs", INPUTS, "--only", loader)
    assert code == 0 and found["finds"] == []
    assert sum(found["loaders"][loader].values()) == INPUTS == found["inputs"]


def test_an_input_is_refused_in_one_line_or_a_find(tmp_path: Path) -> None:
    def refuses(text: str) -> fuzz.Target:
        def attempt(path: Path, rng: object) -> None:
            raise (ZeroDivisionError(text) if text == "by zero" else UsageError(text))

        return fuzz.Target("x", 1, ".x", list, lambda data, rng: data, attempt)

    said = [
        fuzz.attempt(refuses(text), tmp_path, fuzz.generator(0, 0)) for text in ("no", "x" * fuzz.LONGEST, "by zero")
    ]
    assert (
        said[0] == "refused"
        and said[1].startswith("no single line")
        and said[2].startswith("ZeroDivisionError: by zero (")
    )


def die(work: fuzz.Work) -> None:
    """A loading process that ends at its second input."""
    work.number.value = work.start
    if work.start == 0:
        os._exit(11)
    work.number.value = work.end - 1


@pytest.mark.slow
def test_where_a_process_dies_is_a_find_and_another_goes_on_behind_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fuzz, "load_all", die)
    code, found = run(tmp_path / "fuzz", "--inputs", 3)
    assert code == 1 and capsys.readouterr().err == "bench fuzz: 1 finds in 3 files, the process died (11) first\n"
    assert [(find["number"], find["what"]) for find in found["finds"]] == [(0, "the process died (11)")]
