"""The pages in docs/ name what there is, and nothing else."""

import argparse
import re

import pytest

import edgefilter
from edgefilter.cli import build_parser
from edgefilter.engines import ENGINES
from tests.program import ROOT

DOCS = ROOT / "docs"
CLI, API, ARCHITECTURE = ((DOCS / f"{name}.md").read_text() for name in ("cli", "api", "architecture"))


def commands(parser, name="edgefilter"):
    """Every command with options of its own, and these."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    own = {option for action in parser._actions for option in action.option_strings} - {"-h", "--help"}
    if not inner or (own and name != "edgefilter"):
        yield name, own
    for action in inner:
        for word, command in action.choices.items():
            yield from commands(command, f"{name} {word}")


COMMANDS = dict(commands(build_parser()))
SECTIONS = dict(re.findall(r"^## (edgefilter .*?)\n(.*?)(?=^## |\Z)", CLI, re.S | re.M))


def test_the_cli_page_has_a_section_for_each_command():
    assert set(SECTIONS) == set(COMMANDS) and len(COMMANDS) >= 9


@pytest.mark.parametrize("command", COMMANDS)
def test_the_cli_page_lists_the_options_of(command):
    rows = re.findall(r"^\| `(--[a-z-]+)", SECTIONS[command], re.M)
    assert set(rows) == COMMANDS[command] and len(rows) == len(set(rows))


def test_the_cli_page_lists_the_engines():
    assert set(re.findall(r"^\| `([a-z][a-z-]*)` \|", SECTIONS["edgefilter run"], re.M)) == set(ENGINES)


def test_the_api_page_names_every_public_name_and_no_other():
    tables = API.replace(API.split("of an `EgoFilter`")[1].split("##")[0], "")
    first_cells = re.findall(r"^\| (`.*?) \|", tables, re.M)
    named = {name for cell in first_cells for name in re.findall(r"`([A-Za-z_]+)", cell)}
    assert named == set(edgefilter.__all__)


def test_the_api_page_names_all_that_an_ego_filter_has():
    table = API.split("of an `EgoFilter`")[1].split("##")[0]
    own = {name for name in vars(edgefilter.EgoFilter) if not name.startswith("_")}
    assert len(own) > 12 and own <= set(re.findall(r"`([a-z_]+)[`(]", table))


def test_the_architecture_page_names_every_floor():
    picture = ARCHITECTURE.split("```")[1]
    subjects = {
        path.stem for path in (ROOT / "edgefilter").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert subjects - {"__init__"} == {
        word for line in picture.splitlines() for word in re.findall(r"[a-z_]+", line[:38])
    } - {"text"}


def test_pages_name_no_file_that_is_not_there():
    others = (ROOT / name for name in ("README.md", "CONTRIBUTING.md", "bench/README.md", "models/MODELS.md"))
    for page in (*others, *DOCS.glob("*.md")):
        for path in re.findall(r"`((?:edgefilter|bench|export|tests|docs|models)/[\w/.-]+)`", page.read_text()):
            assert (ROOT / path).exists(), f"{page.name}: {path}"
