"""bench is a package like another: nothing is put on the path, the product knows nothing of it, its examples run."""

from __future__ import annotations

import ast
import doctest
import importlib
from pathlib import Path

import pytest

from tests.program import ROOT

FILES = sorted((ROOT / "bench").rglob("*.py"))
EXAMPLES = [path for path in FILES if ">>>" in path.read_text(encoding="utf-8")]


def test_files_were_found() -> None:
    assert len(FILES) > 30 and len(EXAMPLES) >= 3


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_program_changes_the_import_path_or_writes_results_by_itself(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    attributes = {
        f"{node.value.id}.{node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
    }
    assert "sys.path" not in attributes
    if path.name != "results.py":
        suffixes = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and node.value == ".md"}
        assert not suffixes, "pages are written by bench/results.py"


def test_the_product_does_not_know_its_benchmark() -> None:
    for path in sorted((ROOT / "edgefilter").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.split(".")[0] == "bench" for name in names), path


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_docstring_examples_run(path: Path) -> None:
    module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    result = doctest.testmod(module)
    assert result.attempted > 0 and result.failed == 0
