"""The hour on virtual devices, twenty seconds of it."""

import json

import pytest

from bench import __main__ as bench

pytestmark = pytest.mark.slow


def test_twenty_seconds_live_lose_nothing(tmp_path):
    command = ["live", "hour", "--minutes", "0.3333", "--engine", "ss", "--output", str(tmp_path / "live")]
    assert bench.main(command) == 0
    found = json.loads((tmp_path / "live.json").read_text())["parts"]["hour"]
    assert (
        found["samples_in"] == found["samples_out"] == round(0.3333 * 60 * 16000) and found["deadline"]["hops"] >= 1240
    )
    assert not found["source"]["lost"] and "nothing drifted" in (tmp_path / "live.md").read_text()
