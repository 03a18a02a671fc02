"""bench/README.md leads to commands that exist, with options that they have, and names every result."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import re
from pathlib import Path

import pytest

from bench import __main__ as program
from bench import results
from tests.program import ROOT

PAGE = (ROOT / "bench" / "README.md").read_text(encoding="utf-8")
MODULES = re.findall(r"python -m (bench\.[\w.]+)([^`\n]*)", PAGE)
SCENARIOS = re.findall(r"python -m bench (\w+)([^`\n]*)", PAGE)


def options(text: str) -> list[str]:
    return re.findall(r"(?<=\s)--[a-z][a-z-]*", text)


@pytest.mark.parametrize("module", sorted({module for module, _ in MODULES}))
def test_a_generator_has_the_options_of_its_commands(module: str) -> None:
    found = importlib.util.find_spec(module)
    assert found is not None and found.origin
    source = Path(found.origin).read_text(encoding="utf-8")
    for _, text in (command for command in MODULES if command[0] == module):
        assert [option for option in options(text) if f'"{option}"' not in source] == []


@pytest.mark.parametrize("name", sorted({name for name, _ in SCENARIOS if name != "SCENARIO"}))
def test_a_scenario_has_the_options_of_its_commands(name: str) -> None:
    parser = argparse.ArgumentParser()
    program.common(parser)
    importlib.import_module(f"bench.{name}").add_arguments(parser)
    known = set(re.findall(r"^  (?:-h, )?(--[a-z0-9-]+)", parser.format_help(), re.M))
    for _, text in (command for command in SCENARIOS if command[0] == name):
        assert set(options(text)) <= known


def test_the_pages_of_results_that_are_named_are_those_that_are_committed() -> None:
    named = re.findall(r"`results/(\w+\.md)`", PAGE)
    assert named and sorted(named) == sorted(path.name for path in results.RESULTS.glob("*.md"))
    for name in named:
        assert results.read((results.RESULTS / name).with_suffix(".json"))["parts"], name


def test_every_scenario_is_named_and_every_link_leads_somewhere() -> None:
    assert set(program.SCENARIOS) == {name for name, _ in SCENARIOS} - {"SCENARIO"}
    for target in re.findall(r"\]\(([^)#:]+)\)", PAGE):
        assert (ROOT / "bench" / target).exists(), target
