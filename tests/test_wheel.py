"""What people install: the wheel, which .ci/package tries in an environment that has nothing else.

Needs a package index.
"""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

from tests.program import ROOT

BELONGINGS = ("edgefilter", "models", "pyproject.toml", "README.md", "LICENSE", "NOTICE")
NOT_CODE = {
    "edgefilter/py.typed",
    "edgefilter/__init__.pyi",
    "edgefilter/demo_data/LICENSE.md",
    "edgefilter/demo_data/human.flac",
    *(
        f"edgefilter/demo_data/hidden/{case}/{name}"
        for case in ("one", "two")
        for name in ("mic.flac", "profile.npz", "reference.flac", "truth.json")
    ),
    "edgefilter/demo_data/mic.flac",
    "edgefilter/demo_data/profile.npz",
    "edgefilter/demo_data/reference.flac",
    "edgefilter/diagnosis/ordinary.json",
    "edgefilter/models/MODELS.md",
    "edgefilter/models/crnn_int8.onnx",
}
"""All that is neither Python nor a part of the report's page: the public names, the demo's recordings, the network, their licences, and what the
diagnosis finds by chance."""


def clean_environment() -> dict[str, str]:
    """The caller's, without what would let a copy of the package elsewhere be found."""
    return {
        name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    }


def run(*words: object, **options: object) -> str:
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, env=clean_environment(), **options
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy: a build folder left in the checkout would put files that are long gone into the wheel."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in BELONGINGS:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source / name)
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", out, source)
    (made,) = out.glob("*.whl")
    return made


@pytest.mark.slow
def test_the_wheel_holds_every_module_and_nothing_that_is_not_read(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        licences = {Path(name).name for name in archive.namelist() if ".dist-info/licenses/" in name}
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "edgefilter").rglob("*.py")}
    assert len(modules) > 80 and {name for name in names if name.endswith(".py")} == modules
    page = {name for name in names if name.startswith("edgefilter/report/") and not name.endswith(".py")}
    assert page and names - modules - page == NOT_CODE
    assert licences == {"LICENSE", "NOTICE", "LICENSE.md"}


def test_each_core_dependency_is_bound_below_and_below_its_next_major_version_and_the_bounds_hold_here():
    stated = re.search(r"^dependencies = \[(.*?)^\]", (ROOT / "pyproject.toml").read_text(), re.S | re.M)[1]
    found = re.findall(r'"([a-z-]+)>=([\d.]+),<(\d+)"', stated)
    assert len(found) == len(re.findall('"', stated)) // 2 >= 7
    for name, least, below in found:
        here = tuple(int(part) for part in metadata.version(name).split(".")[:3])
        assert tuple(int(part) for part in least.split(".")) <= here and here[0] < int(below), name


def test_the_notice_names_every_network_of_the_repository_and_no_other():
    named = re.findall(r"((?:bench/)?models/\w+\.(?:onnx|pt))", (ROOT / "NOTICE").read_text())
    there = (path for folder in ("models", "bench/models") for path in (ROOT / folder).iterdir())
    networks = (path.relative_to(ROOT).as_posix() for path in there if path.suffix in (".onnx", ".pt"))
    assert sorted(named) == sorted(networks)
