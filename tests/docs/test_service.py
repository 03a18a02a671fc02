"""The systemd unit among the examples says what the command line understands."""

import configparser
import shlex
from pathlib import Path

from edgefilter.audio import virtual
from edgefilter.cli import build_parser

UNIT = Path(__file__).parents[2] / "docs/examples/edgefilter.service"


class Repeated(dict):
    """A section in which a word may come more than once: its values are joined by newlines."""

    def __setitem__(self, key, value):
        if key in self and isinstance(value, list):
            value = self[key] + value
        super().__setitem__(key, value)


def test_each_command_of_the_service_is_one_of_ours_with_options_that_it_has():
    unit = configparser.ConfigParser(strict=False, interpolation=None, dict_type=Repeated)
    unit.optionxform = str
    unit.read(UNIT)
    service = unit["Service"]
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
    assert set(unit.sections()) == {"Unit", "Service", "Install"} and unit["Install"]["WantedBy"] == "default.target"
