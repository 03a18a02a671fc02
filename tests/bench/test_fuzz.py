"""The fuzzer itself: every loader has files to start from, and a few damaged ones of each are refused or taken."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bench.fuzz.targets import TARGETS

ROOT = Path(__file__).parents[2]
INPUTS = 12


@pytest.mark.parametrize("loader", [target.name for target in TARGETS])
def test_a_few_damaged_files_of_each_loader_keep_every_promise(loader: str, tmp_path: Path) -> None:
    page = tmp_path / "fuzz"
    command = [sys.executable, "-m", "bench.fuzz", "--inputs", str(INPUTS), "--only", loader, "--output", str(page)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(page.with_suffix(".json").read_text())
    assert found["finds"] == []
    assert sum(found["loaders"][loader].values()) == INPUTS
