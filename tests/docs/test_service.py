"""The systemd units among the examples say what the command line and systemd understand."""

import configparser
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from edgefilter.audio import virtual
from edgefilter.cli import build_parser

EXAMPLES = Path(__file__).parents[2] / "docs/examples"
UNITS = sorted(EXAMPLES.glob("*.service"))


class Repeated(dict):
    """A section in which a word may come more than once: its values are joined by newlines."""

    def __setitem__(self, key, value):
        if key in self and isinstance(value, list):
            value = self[key] + value
        super().__setitem__(key, value)


def read(name):
    unit = configparser.ConfigParser(strict=False, interpolation=None, dict_type=Repeated)
    unit.optionxform = str
    unit.read(EXAMPLES / name)
    assert set(unit.sections()) == {"Unit", "Service", "Install"} and unit["Install"]["WantedBy"] == "default.target"
    return unit["Service"]


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_systemd_finds_nothing_to_say_of_the_unit(unit, tmp_path):
    """With this environment's program in the place of the user's."""
    assert len(UNITS) == 2
    program = tmp_path / ".local/bin/edgefilter"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m edgefilter.cli "$@"\n')
    program.chmod(0o755)
    copy = tmp_path / unit.name
    copy.write_text(unit.read_text().replace("%h", str(tmp_path)))
    done = subprocess.run(["systemd-analyze", "verify", copy], capture_output=True, text=True)
    assert done.returncode == 0 and str(copy) not in done.stderr, done.stderr
    copy.write_text(copy.read_text().replace("RestartSec=", "RestartSex="))
    said = subprocess.run(["systemd-analyze", "verify", copy], capture_output=True, text=True).stderr
    assert "RestartSex" in said, "a word that systemd does not know would be noticed"


def test_the_service_for_devices_elsewhere_has_a_secret_and_options_that_there_are():
    args = build_parser().parse_args(shlex.split(read("edgefilter-serve.service")["ExecStart"])[1:])
    assert args.command == "serve" and args.token and args.host == "0.0.0.0"


def test_each_command_of_the_service_is_one_of_ours_with_options_that_it_has():
    service = read("edgefilter.service")
    commands = [
        shlex.split(line)
        for name in ("ExecStartPre", "ExecStart", "ExecStopPost")
        for line in service[name].split("\n")
        if "/edgefilter " in line
    ]
    parsed = [build_parser().parse_args(words[1:]) for words in commands]
    assert [args.command for args in parsed] == ["devices", "run", "devices"]
    assert parsed[0].load and parsed[2].unload
    assert parsed[1].input == "mic" and parsed[1].output == virtual.HUMAN and parsed[1].quiet
