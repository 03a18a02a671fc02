"""Each row of docs/faults.md is made to happen by a test that exists."""

import ast
import re

import pytest

from tests.program import ROOT

ROWS = [
    line
    for line in (ROOT / "docs" / "faults.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("| ") and not line.startswith(("| --- |", "| fault |", "| input |"))
]


def test_the_page_has_the_faults():
    assert len(ROWS) >= 25
    for word in (
        "unplugged",
        "stutters",
        "too slow",
        "300 ppm",
        "mono",
        "full",
        "SIGINT",
        "SIGTERM",
        "SIGKILL",
        "sleeps",
    ):
        assert any(word in row for row in ROWS), word


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[2:40])
def test_a_row_names_a_test_that_is_there(row):
    path, name = re.search(r"`(tests/[\w/]+\.py)::(test_\w+)` \|$", row).groups()
    functions = {
        node.name for node in ast.parse((ROOT / path).read_text(encoding="utf-8")).body if hasattr(node, "name")
    }
    assert name in functions
