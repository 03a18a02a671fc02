"""bench/README.md leads from each result to a command that exists, with options that it has."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "bench" / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"python -m (bench\.[\w.]+)([^`\n]*)", PAGE)


@pytest.mark.parametrize("module", sorted({module for module, _ in COMMANDS}))
def test_a_command_is_a_program_with_these_options(module: str) -> None:
    assert importlib.util.find_spec(module) is not None
    place = ROOT / Path(*module.split("."))
    source = (place / "__main__.py" if place.is_dir() else place.with_suffix(".py")).read_text(encoding="utf-8")
    assert '__name__ == "__main__"' in source
    for _, options in (command for command in COMMANDS if command[0] == module):
        for option in re.findall(r"(?<=\s)--[a-z][a-z-]*", options):
            assert f'"{option}"' in source, option


def test_every_result_has_a_row_and_every_page_named_is_there() -> None:
    named = set(re.findall(r"\]\(results/(\w+)\.(?:md|json)\)", PAGE))
    assert named == {path.stem for path in (ROOT / "bench" / "results").glob("*.json")}
    for target in re.findall(r"\]\(([^)#:]+)\)", PAGE):
        assert (ROOT / "bench" / target).exists(), target


def test_there_are_commands_to_check() -> None:
    assert len(COMMANDS) >= 20
