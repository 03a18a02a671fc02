"""What others wrote stays text where it is told: names in files and messages reach no terminal and no second line of a log."""

from __future__ import annotations

import json

import numpy as np
import pytest

from edgefilter import errors
from edgefilter.cli import main
from tests.program import DEMO

HOSTILE = "reverb\x1b]0;owned\x07\x1b[2J\nedgefilter: all is well\u202e\x9b"
"""A name that sets a terminal's title, clears it, writes a line of its own, and turns the writing around."""


@pytest.mark.parametrize("kind", [each for each in vars(errors).values() if isinstance(each, type)])
def test_every_error_is_one_line_that_only_prints(kind):
    said = str(kind(f"found {HOSTILE}, expected another"))
    assert said.isprintable() and said.startswith("found reverb\\x1b]0;owned\\x07") and "expected another" in said


def told_of_profile(folder, capsys, **header):
    """All that `profile show` prints of the demo's profile with another header."""
    with np.load(DEMO / "profile.npz") as archive:
        members = dict(archive)
    found = json.loads(members["header"].tobytes()) | header
    members["header"] = np.frombuffer(json.dumps(found).encode(), np.uint8)
    np.savez(folder / "robot.npz", **members)
    code = main(["profile", "show", str(folder / "robot.npz")])
    return code, "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("header", "code"),
    [
        ({"effects": [{"name": HOSTILE, "values": {}}]}, 1),
        ({"effects": [{"name": "clock_drift", "values": {HOSTILE: 1.0}}]}, 1),
        ({HOSTILE: 1}, 1),
        ({"warnings": [HOSTILE]}, 0),
        ({"source": HOSTILE, "created": HOSTILE}, 0),
    ],
    ids=("effect", "value", "field", "warning", "source"),
)
def test_names_and_texts_in_a_profile_that_control_the_terminal_are_told_as_text(header, code, tmp_path, capsys):
    found, told = told_of_profile(tmp_path, capsys, **header)
    assert found == code and "reverb\\x1b]0;owned" in told
    assert all(line.isprintable() for line in told.split("\n"))
