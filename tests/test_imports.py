"""What importing costs. Who may import whom stands in pyproject.toml, and lint-imports checks it."""

import json
import re
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "edgefilter"
HEAVY = {"sounddevice", "onnxruntime", "matplotlib", "jinja2", "torch"}


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


def test_importing_the_package_loads_nothing_and_the_command_line_no_heavy_package():
    assert loaded_by("edgefilter") == {"edgefilter", "lazy_loader"}
    assert {"edgefilter", "numpy"} <= loaded_by("edgefilter.cli") and not loaded_by("edgefilter.cli") & HEAVY


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


def test_nothing_inside_goes_by_way_of_the_public_names():
    """They would hide who imports whom; the version alone is defined there."""
    lines = [line for path in PACKAGE.rglob("*.py") for line in path.read_text().splitlines()]
    taken = {line.split()[-1] for line in lines if line.startswith(("from edgefilter import", "import edgefilter"))}
    assert taken == {"__version__", "engines"}


def test_no_test_imports_what_another_file_of_tests_holds():
    files = (Path(__file__).parent).rglob("*.py")
    taken = {
        path.name: re.findall(r"^\s*(?:from|import) tests\.(?:\w+\.)*test_\w+", path.read_text(), re.M)
        for path in files
    }
    assert not {name: lines for name, lines in taken.items() if lines}
