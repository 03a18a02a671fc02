"""The house's rules about who may import what, read from the source and seen in a fresh interpreter."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Arrow:
    """One import of another module of the package. typing: under TYPE_CHECKING, so that nothing runs."""

    importer: str
    imported: str
    typing: bool


PACKAGE = Path(__file__).parents[1] / "edgefilter"
FILES = sorted(PACKAGE.rglob("*.py"))
LEAVES = {
    "sounddevice": {"audio/device.py"},
    "onnxruntime": {"engines/onnx_session.py"},
    "matplotlib": {"report/plots.py"},
    "jinja2": {"report/html.py"},
    "pipecat": {"integrations/pipecat.py"},
    "livekit": {"integrations/livekit.py"},
    "wyoming": {"integrations/wyoming.py"},
    "websockets": {"integrations/serve.py"},
    "av": {"integrations/opus.py"},
    "sic_framework": {"integrations/sic.py"},
    "redis": {"integrations/sic.py"},
    "cyclonedds": {"integrations/ros2.py"},
    "rosbags": {"integrations/bags.py"},
    "torch": set(),
    "export": set(),
}
LAYERS = (
    {"errors", "types"},
    {"dsp", "selfecho"},
    {"echo"},
    {"profile"},
    {"alignment", "engines"},
    {"filter", "audio"},
    {"calibration"},
    {"diagnosis"},
    {"session", "report", "integrations"},
    {"learning"},
    {"commands"},
    {"cli"},
    {"__main__"},
)
"""Folders and files of the package from the ground up (docs/architecture.md). A subject may import its own and what
stands lower, never a neighbour on its own floor. edgefilter/__init__.py is the door: it leads to all of them, and
nothing in the house goes out to come in."""
STATED = {("types", "errors")}
"""The one arrow between neighbours: as_samples() raises SignalError."""


def module(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module(path): path for path in FILES}


@cache
def imports(path: Path) -> list[tuple[str, bool]]:
    """Every name that a file imports, at its top or inside a function, and whether for type checkers alone."""
    found: list[tuple[str, bool]] = []

    def visit(node: ast.AST, typing: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend((alias.name, typing) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.extend((f"{node.module}.{alias.name}", typing) for alias in node.names)
        elif isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            for child in node.body:
                visit(child, True)
            for child in node.orelse:
                visit(child, typing)
        else:
            for child in ast.iter_child_nodes(node):
                visit(child, typing)

    visit(ast.parse(path.read_text()), False)
    return found


def arrows_of(importer: str, path: Path) -> set[Arrow]:
    """The arrows of one module; `from a import b` points at the module a.b where there is one, else at a."""
    found = set()
    for name, typing in imports(path):
        target = name if name in MODULES else name.rpartition(".")[0]
        if target in MODULES and target != "edgefilter":
            found.add(Arrow(importer, target, typing))
    return found


@cache
def all_arrows() -> set[Arrow]:
    """Those of the whole package."""
    return {arrow for name, path in MODULES.items() if name != "edgefilter" for arrow in arrows_of(name, path)}


def floor(name: str) -> int:
    subject = name.split(".")[1]
    floors = [number for number, subjects in enumerate(LAYERS) if subject in subjects]
    assert len(floors) == 1, (
        f"edgefilter.{subject} stands on {len(floors)} floors: say in LAYERS on which one it stands"
    )
    return floors[0]


def upward(arrows: set[Arrow]) -> list[str]:
    """The arrows that do not point down, in words."""
    wrong = []
    for arrow in arrows:
        subjects = tuple(name.split(".")[1] for name in (arrow.importer, arrow.imported))
        if subjects[0] != subjects[1] and subjects not in STATED and floor(arrow.imported) >= floor(arrow.importer):
            wrong.append(f"{arrow.importer} imports {arrow.imported}, which stands no lower")
    return sorted(wrong)


def circles(arrows: set[Arrow]) -> list[list[str]]:
    """Sets of modules that import one another, directly or by way of others (strongly connected components, Tarjan 1972)."""
    onward: dict[str, list[str]] = {}
    for arrow in sorted(arrows, key=lambda arrow: (arrow.importer, arrow.imported)):
        onward.setdefault(arrow.importer, []).append(arrow.imported)
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(name: str) -> None:
        number[name] = low[name] = len(number)
        stack.append(name)
        for other in onward.get(name, ()):
            if other not in number:
                visit(other)
            if other in stack:
                low[name] = min(low[name], low[other])
        if low[name] == number[name]:
            at = stack.index(name)
            ring = stack[at:]
            del stack[at:]
            if len(ring) > 1 or name in onward.get(name, ()):
                found.append(sorted(ring))

    for name in onward:
        if name not in number:
            visit(name)
    return found


def between_rooms(arrows: set[Arrow]) -> Counter[tuple[str, str]]:
    """How many imports lead from one room (a folder or a file of the package) to another: (from, to): number."""
    pairs = {(arrow.importer, arrow.imported) for arrow in arrows}
    rooms = Counter((importer.split(".")[1], imported.split(".")[1]) for importer, imported in pairs)
    return Counter(
        {(importer, imported): count for (importer, imported), count in rooms.items() if importer != imported}
    )


def summary() -> str:
    """The house in one line, as docs/architecture.md has it and docs/draw_imports.py writes it into its picture."""
    rooms, arrows, rings = set().union(*LAYERS), between_rooms(all_arrows()), circles(all_arrows())
    return f"{len(rooms)} rooms on {len(LAYERS)} floors, {len(arrows)} arrows between rooms, {len(rings)} circles"


def fresh(code: str) -> str:
    """What a new interpreter prints."""
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent
    ).stdout.strip()


def loaded_by(name: str) -> set[str]:
    """Top-level packages outside the standard library that importing a module brings into a new interpreter."""
    code = (
        f"import sys, json; before = set(sys.modules); import {name}; print(json.dumps(sorted(set(sys.modules) -"
        " before)))"
    )
    return {found.split(".")[0] for found in json.loads(fresh(code))} - set(sys.stdlib_module_names)


def test_files_and_arrows_were_found():
    assert len(FILES) > 80 and len(all_arrows()) > 300
    assert Arrow("edgefilter.filter.ego_filter", "edgefilter.filter.stream", False) in all_arrows()
    assert Arrow("edgefilter.engines", "edgefilter.profile.data", True) in all_arrows()


@pytest.mark.parametrize("heavy", LEAVES)
def test_heavy_packages_are_imported_in_their_leaf_only(heavy):
    users = {
        str(path.relative_to(PACKAGE))
        for path in FILES
        if any(name.split(".")[0] == heavy for name, _ in imports(path))
    }
    assert users == LEAVES[heavy]


def test_every_subject_has_a_floor_and_every_floor_its_subjects():
    subjects = {name.split(".")[1] for name in MODULES if name != "edgefilter"}
    assert subjects == set().union(*LAYERS)


def test_imports_point_downwards():
    """Those of a type checker as well: who only names a type from above knows of what is above."""
    assert upward(all_arrows()) == []


def test_nothing_imports_the_door():
    """The version alone is defined there; every other name would be loaded from inside the house by way of the street."""
    inside = {(name, found) for name, path in MODULES.items() if name != "edgefilter" for found, _ in imports(path)}
    assert {found for _, found in inside if found.rpartition(".")[0] == "edgefilter" and found not in MODULES} <= {
        "edgefilter.__version__"
    }
    assert not [name for name, found in inside if found == "edgefilter"]


def test_there_are_no_circles_not_even_inside_a_subject():
    """Imports inside functions and under TYPE_CHECKING count: both hide a circle and open none."""
    assert circles(all_arrows()) == []


def test_an_arrow_that_points_up_and_a_circle_are_seen():
    up = Arrow("edgefilter.echo.model", "edgefilter.profile.data", False)
    beside = Arrow("edgefilter.engines.linear", "edgefilter.alignment.aligner", True)
    assert len(upward({up, beside, Arrow("edgefilter.cli", "edgefilter.errors", False)})) == 2
    ring = {Arrow(a, b, False) for a, b in ("ab", "bc", "ca", "cd", "ee")}
    assert sorted(circles(ring)) == [["a", "b", "c"], ["e"]]


def test_the_page_and_its_picture_tell_the_counts_of_today():
    """Where this fails: python -m docs.draw_imports, and the line it prints into the page."""
    docs = PACKAGE.parent / "docs"
    assert summary() in " ".join((docs / "architecture.md").read_text().split())
    assert summary().encode() in (docs / "imports.png").read_bytes()


def test_imports_between_rooms_are_counted_once_for_each_pair_of_files():
    pairs = [("a.x", "b.y"), ("a.z", "b.y"), ("a.x", "a.z"), ("b.y", "c")]
    arrows = {Arrow(f"p.{a}", f"p.{b}", typing) for a, b in pairs for typing in (False, True)}
    assert between_rooms(arrows) == {("a", "b"): 2, ("b", "c"): 1}


def test_importing_the_package_loads_nothing_and_the_command_line_no_heavy_package():
    assert loaded_by("edgefilter") == {"edgefilter"}
    assert {"edgefilter", "numpy"} <= loaded_by("edgefilter.cli") and not loaded_by("edgefilter.cli") & set(LEAVES)


def test_the_running_filter_loads_no_slow_part_of_scipy():
    """scipy.signal alone takes as long to import as everything else that a run needs."""
    code = (
        "import sys, numpy, edgefilter.commands.run\n"
        "from edgefilter import EgoFilter\n"
        "x = numpy.zeros(1000, numpy.float32)\n"
        "EgoFilter(engine='ss').process(x, x)\n"
        "print(*(name for name in sys.modules if name in ('scipy.signal', 'scipy.optimize', 'scipy.stats')))"
    )
    assert fresh(code) == ""
