"""What the README promises to type is what works."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

from edgefilter.cli import build_parser

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def test_the_python_example_runs(tmp_path):
    examples = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len(examples) == 1
    code = examples[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "dB" in result.stdout


def test_every_command_line_in_the_readme_parses():
    lines = [line.strip() for block in re.findall(r"```(?:sh|text)\n(.*?)```", README, re.S) for line in block.splitlines()]
    commands = [line.split("edgefilter ", 1)[1].split("#")[0] for line in lines if re.match(r"(\S+/)?edgefilter [a-z]", line)]
    assert len(commands) >= 5
    for words in commands:
        build_parser().parse_args(shlex.split(words))


def test_links_and_pictures_exist():
    targets = [target for target in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in target]
    assert targets
    for target in targets:
        assert (ROOT / target).exists(), target
