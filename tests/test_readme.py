"""What the README and docs/ promise to type is what works."""

import os
import re
import shlex
import subprocess
import sys

import pytest

from edgefilter.cli import build_parser
from tests.program import ROOT

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LEAST_COMMANDS = {
    "README.md": 1,
    "index.md": 3,
    "cli.md": 12,
    "diagnosis.md": 3,
    "own_effect.md": 3,
    "live.md": 3,
    "calibrate.md": 3,
    "filter_a_file.md": 2,
}
README = (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_what_the_short_test_line_runs_needs_nothing_of_the_training_side():
    whole, short = (line for line in README.splitlines() if "-m pytest" in line)
    assert (
        "'.[test,export]'" in whole
        and "'.[test]'" in short
        and short.endswith("--ignore=tests/export")
        and "ignore" not in whole
    )
    files = [path for path in (ROOT / "tests").rglob("test_*.py") if "export" not in path.parts]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files]
    assert len(names) > 40
    code = (
        "import importlib, sys\n"
        "class Missing:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name.split('.')[0] in ('torch', 'export', 'tensorboard', 'faster_whisper'):\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Missing())\n"
        f"for name in {names}: importlib.import_module(name)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_first_python_example_runs(tmp_path):
    code = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "embed.md").read_text(), re.S)[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "dB" in result.stdout


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_command_line_parses(document):
    blocks = re.findall(r"```(?:sh|text)\n(.*?)```", document.read_text(), re.S)
    lines = [line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    commands = [
        line.split("edgefilter ", 1)[1].split("#")[0] for line in lines if re.match(r"(\S+/)?edgefilter [a-z]", line)
    ]
    assert len(commands) >= LEAST_COMMANDS.get(document.name, 0)
    for words in commands:
        build_parser().parse_args(shlex.split(words))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_and_pictures_exist(document):
    targets = [target for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()) if "://" not in target]
    assert targets or document.name != "README.md"
    for target in targets:
        assert (document.parent / target).exists(), target
