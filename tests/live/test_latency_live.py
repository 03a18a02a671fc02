"""The click that goes round and the live soak, as the benchmarks run them."""

import json
import sys

import pytest

from bench.measure import latency_live, soak

pytestmark = pytest.mark.slow


def test_a_click_comes_back_no_sooner_than_the_window_allows():
    times = latency_live.round_trip("linear", clicks=1)
    assert 32.0 < times[0] < 1000.0  # the window at least; the devices' buffers on top


def test_twenty_seconds_live_lose_nothing(tmp_path, monkeypatch):
    arguments = ["soak.py", "--live", "0.3333", "--slices", "10", "--engine", "ss", "--output", str(tmp_path / "soak")]
    monkeypatch.setattr(sys, "argv", arguments)
    assert soak.main() == 0
    found = json.loads((tmp_path / "soak.json").read_text())
    assert (
        found["samples_in"] == found["samples_out"] == round(0.3333 * 60 * 16000) and found["deadline"]["hops"] >= 1240
    )
    assert not found["source"]["lost"] and "live" in (tmp_path / "soak.md").read_text()
