"""The house's rules about who may import what, read from the source and seen in a fresh interpreter."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "edgefilter"
FILES = sorted(PACKAGE.rglob("*.py"))
LEAVES = {
    "sounddevice": {"audio/device.py"},
    "onnxruntime": {"engines/onnx_session.py"},
    "matplotlib": {"report/plots.py"},
    "jinja2": {"report/html.py"},
    "torch": set(),
    "export": set(),
}
LAYERS = [
    {"types", "errors", "timing", "budget_cache"},
    {"fourier", "stft", "ring", "metrics"},
    {"echo"},
    {"profile", "profile_file", "profile_text", "delay_line", "utterances"},
    {"announced"},
    {"lag_search", "delay_tracker", "jumps", "paper_alignment", "alignment", "onset_gate", "canceller", "residual", "engines"},
    {"front"},
    {"stepping", "barge_in", "stream", "audio", "budget", "run"},
    {"sweep", "paper_response", "trust", "calibrate"},
    {"offset", "prepare", "self_calibration", "compare", "judge", "suspects", "trials", "fan", "settle", "search", "leftover", "band_edge", "findings", "evidence", "conclude", "diagnose"},
    {"report"},
    {"commands"},
    {"cli"},
]


def imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def layer(module: str) -> int:
    part = module.split(".")[1]
    ranks = [rank for rank, names in enumerate(LAYERS) if part in names]
    assert ranks, f"edgefilter.{part} has no layer: say in LAYERS where it stands"
    return ranks[0]


def test_files_were_found():
    assert len(FILES) > 15


@pytest.mark.parametrize("heavy", LEAVES)
def test_heavy_packages_are_imported_in_their_leaf_only(heavy):
    users = {str(path.relative_to(PACKAGE)) for path in FILES if any(name.split(".")[0] == heavy for name in imported(path))}
    assert users <= LEAVES[heavy]


@pytest.mark.parametrize("path", [f for f in FILES if f.parent != PACKAGE or f.stem != "__init__"], ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    own = layer(".".join(("edgefilter", *path.relative_to(PACKAGE).with_suffix("").parts)))
    for name in imported(path):
        if name.startswith("edgefilter.") and name != "edgefilter.__version__":
            assert layer(name) <= own, f"{path.name} imports {name}, which stands above it"


def test_importing_the_package_loads_no_heavy_package():
    code = "import sys, json, edgefilter, edgefilter.cli; print(json.dumps(sorted({m.split('.')[0] for m in sys.modules})))"
    loaded = set(json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout))
    assert "numpy" in loaded
    assert not loaded & set(LEAVES)


def test_the_running_filter_loads_no_slow_part_of_scipy():
    """scipy.signal alone takes as long to import as everything else that a run needs."""
    code = (
        "import sys, numpy, edgefilter.commands.run\n"
        "from edgefilter import EgoFilter\n"
        "x = numpy.zeros(1000, numpy.float32)\n"
        "EgoFilter(engine='ss').process(x, x)\n"
        "print(*(name for name in sys.modules if name in ('scipy.signal', 'scipy.optimize', 'scipy.stats')))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == ""
