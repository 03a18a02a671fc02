"""Mutants: drawn where code runs, the same for a seed; killed by a test that fails, surviving where none does."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from bench import __main__ as bench
from bench import mutate, provenance, results
from edgefilter.errors import UsageError

CODE = '''"""A module."""


def twice(x: int | None) -> int:
    return 2 * x


def never_tested(x: int) -> int:
    return x - 1
'''
TEST = """from edgefilter.alignment.twice import twice


def test_twice():
    assert twice(3) == 6
"""


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with one module of two functions, one of them tested."""
    root = tmp_path / "checkout"
    for folder in ("edgefilter/alignment", "tests/alignment", "docs/results"):
        (root / folder).mkdir(parents=True)
    for place in ("edgefilter/__init__.py", "edgefilter/alignment/__init__.py", "docs/results/large.json"):
        (root / place).write_text("")
    (root / "edgefilter/alignment/twice.py").write_text(CODE)
    (root / "tests/alignment/test_twice.py").write_text(TEST)
    (root / "tests/pytest.ini").write_text("[pytest]\nmarkers = slow\n")
    monkeypatch.setattr(results, "ROOT", root)
    monkeypatch.setattr(provenance, "stamp", lambda *of: {"command": "c", "commit": "0", "dirty": False, "data": [],
                                                       "models": {}, "judged": {}, "machine": {}, "date": ""})  # fmt: skip
    return root


def test_annotations_are_no_places(checkout: Path) -> None:
    found = mutate.sample(["alignment"], 100, 1)
    assert sorted((mutant.line, mutant.before) for mutant in found) == [
        (5, "return 2 * x"), (5, "return 2 * x"), (9, "return x - 1"), (9, "return x - 1")
    ]  # fmt: skip
    assert all(mutant.after != mutant.before for mutant in found)
    assert (
        mutate.sample(["alignment"], 2, 7) == mutate.sample(["alignment"], 2, 7) != mutate.sample(["alignment"], 2, 8)
    )


def test_numbers_that_have_a_name_are_doubled_and_halved() -> None:
    source = "A, B = 3, 0.5 * 4\n\n\nclass Settings:\n    wait_s: float = 0.5\n    name: str = 'one'\n"
    assert [at for at, of in mutate.numbers(source).items() if of] == [(1, 7), (1, 10), (5, 20)]
    found = {}
    for operator in mutate.SCALED:
        for occurrence in range(3):
            exec(mutate.mutated(source, operator, occurrence), names := {})
            found[operator, occurrence] = (names["A"], names["B"], names["Settings"].wait_s)
    assert found == {
        ("double", 0): (6, 2.0, 0.5), ("double", 1): (3, 4.0, 0.5), ("double", 2): (3, 2.0, 1.0),
        ("halve", 0): (1, 2.0, 0.5), ("halve", 1): (3, 1.0, 0.5), ("halve", 2): (3, 2.0, 0.25),
    }  # fmt: skip


@pytest.mark.slow
def test_what_a_test_notices_is_killed_and_what_none_does_survives(
    checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "mutate"
    known = tmp_path / "cache" / "mutants.jsonl"
    kept = ["--cache", str(known.parent), "--output", str(output)]
    command = ["mutate", "--modules", "alignment", "--count", "4", "--jobs", "2", *kept]
    assert bench.main(command) == 0
    tried = known.read_text()
    assert bench.main(command) == 0
    assert known.read_text() == tried  # nothing is tried twice: a run that was stopped goes on
    part = json.loads(output.with_suffix(".json").read_text())["parts"]["mutate"]
    assert {(row["line"], row["outcome"]) for row in part["mutants"]} == {(5, "killed"), (9, "survived")}
    page = output.with_suffix(".md").read_text()
    assert "| alignment | 4 | 2 | 2 | 50 [15, 85] |" in page and "| edgefilter/alignment/twice.py:9 |" in page
    assert (checkout / "edgefilter/alignment/twice.py").read_text() == CODE  # only copies are changed
    (checkout / "tests/alignment/test_never.py").write_text(
        "from edgefilter.alignment.twice import never_tested\n\n\ndef test_it():\n    assert never_tested(5) == 4\n"
    )
    assert bench.main([*command, "--again"]) == 0
    part = json.loads(output.with_suffix(".json").read_text())["parts"]["mutate"]
    assert {row["outcome"] for row in part["mutants"]} == {"killed"}
    assert bench.main([*command, "--again", "--seed", "5", "--count", "3"]) == 1
    assert "is not of these 3 mutants" in capsys.readouterr().err


@pytest.mark.slow
def test_a_mutant_that_never_ends_is_killed_by_the_clock(checkout: Path) -> None:
    (checkout / "tests/alignment/test_twice.py").write_text("import time\n\n\ndef test_it():\n    time.sleep(60)\n")
    (mutant,) = mutate.sample(["alignment"], 1, 1)
    with mutate.copies(1) as free:
        assert mutate.attempt(free, mutant, {"limit_s": 2.0, "tests": [], "lines": {}}) == "timeout"
        copy = free.get_nowait()
        assert (copy / mutant.module).read_text() == CODE and not (copy / "docs/results").exists()


@pytest.mark.slow
def test_a_mutant_meets_the_tests_that_reach_its_statement(checkout: Path) -> None:
    """A test by its call, a file by what its fixtures prepare, every test where a line runs on import alone."""
    tests = checkout / "tests/alignment"
    (tests / "test_prepared.py").write_text(
        "import pytest\n\nfrom edgefilter.alignment.twice import never_tested\n\n\n@pytest.fixture\ndef three():\n"
        "    return never_tested(4)\n\n\ndef test_three(three):\n    assert three == 3\n"
    )
    (checkout / "tests/live").mkdir()
    for package in (tests.parent, tests, checkout / "tests/live"):
        (package / "__init__.py").write_text("")
    (checkout / "tests/live/test_twice.py").write_text(TEST)
    (checkout / "tests/live/test_other.py").write_text(TEST)
    with mutate.copies(1) as free:
        reach = mutate.measured(free, "alignment")
        copy = free.get_nowait()
    drawn = {mutant.line: mutant for mutant in mutate.sample(["alignment"], 3, 1)}
    shutil.copytree(checkout, copy)
    assert mutate.targets(copy, drawn[5], reach) == [
        f"tests/{name}/test_twice.py::test_twice" for name in ("alignment", "live")
    ]
    assert mutate.targets(copy, drawn[9], reach) == ["tests/alignment/test_prepared.py"]
    assert mutate.targets(copy, replace(drawn[9], line=8), reach) == [
        "tests/alignment/test_twice.py", "tests/live/test_twice.py", "tests/alignment/test_prepared.py"
    ]  # fmt: skip


@pytest.mark.parametrize(("line", "span"), [(1, (1, 3)), (2, (1, 3)), (4, (4, 4)), (5, (5, 6)), (6, (5, 6))])
def test_a_line_belongs_to_its_innermost_statement(line: int, span: tuple[int, int]) -> None:
    source = "@cache\ndef f(\n    x):\n    if x:\n        return (\n            1)\n"
    assert mutate.statement(source, line) == span


@pytest.mark.slow
def test_tests_that_fail_anyway_and_folders_without_tests_are_one_line(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(checkout / "tests/alignment")
    assert bench.main(["mutate", "--modules", "alignment"]) == 1
    assert "expected folders of edgefilter/ that tests/ has as well" in capsys.readouterr().err
    (checkout / "tests/alignment").mkdir()
    (checkout / "tests/alignment/test_twice.py").write_text(TEST.replace("6", "7"))
    with mutate.copies(1) as free, pytest.raises(UsageError, match="tests of alignment fail without a mutant"):
        mutate.measured(free, "alignment")
