"""A result of another behaviour than today's is named; a pure move of code leaves it as it is."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench import __main__ as program
from bench import provenance, results, stale, systems
from bench.cache import Cache
from bench.closed_loop import Output


def test_a_result_is_stale_where_a_system_gives_another_sound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    gain = [1.0]
    known = systems.catalogue()
    row = replace(known["unfiltered"], name="half", run=lambda clip: Output(np.float32(gain[0]) * clip.mic))
    monkeypatch.setattr(systems, "catalogue", lambda *_: {"half": row, "unfiltered": known["unfiltered"]})
    provenance.digest_of.cache_clear()
    results.write(tmp_path / "devices", "devices", "D", provenance.stamp(systems=["half", "unfiltered", "nobody"]))
    assert set(results.read(tmp_path / "devices.json")["parts"]["devices"]["stamp"]["judged"]) == {"half", "unfiltered"}
    file = str(tmp_path / "devices.json")
    assert program.main(["stale", file]) == 0
    gain[0] = 1.0 + 1e-9  # rounding that no 16-bit sample shows
    provenance.digest_of.cache_clear()
    assert program.main(["stale", file]) == 0
    gain[0] = 0.5
    provenance.digest_of.cache_clear()
    assert program.main(["stale", file]) == 1
    assert "devices.json, devices: half behave differently now" in capsys.readouterr().err
    old = tmp_path / "old.json"
    old.write_text(json.dumps({"schema": 2, "rows": []}))
    assert stale.stale(old, Cache(None)) == ["old.json: of an earlier form"]
    provenance.digest_of.cache_clear()


def test_a_computing_time_is_stale_where_the_code_that_ran_is_another_though_it_sounds_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path)
    monkeypatch.setattr(provenance, "_found", {})
    files = [tmp_path / folder / "code.py" for folder in (*provenance.RUNNING, "commands")]
    for file in files:
        file.parent.mkdir()
        file.write_text("quick = True")
    page = tmp_path / "latency"
    results.write(page, "latency", "L", provenance.stamp(systems=[provenance.TIMED]))
    files[-1].write_text("what no hop runs = True")
    for file, reasons in ((files[-1], []), (files[0], ["latency.json, latency: timed code behave differently now"])):
        file.write_text("quick = False")
        provenance.digest_of.cache_clear()
        assert stale.stale(page.with_suffix(".json"), Cache(None)) == reasons
    provenance.digest_of.cache_clear()


def test_what_is_learned_is_computed_once_for_the_same_code_and_anew_for_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each look took minutes of a processor."""
    heard: list[str] = []
    known = systems.catalogue()["unfiltered"]
    row = replace(
        known, name="half-learning", run=lambda clip: heard.append(clip.source.name) or Output(0.5 * clip.mic)
    )
    monkeypatch.setattr(systems, "catalogue", lambda *_: {row.name: row})
    found = []
    for code in ("one", "one", "two"):
        monkeypatch.setattr(results, "code_digest", lambda files=None, code=code: code)
        provenance.digest_of.cache_clear()
        found.append(stale.today(row.name, Cache(tmp_path, "digests")))
    assert len(set(found)) == 1 and len(heard) == 2  # one demonstration each time
    provenance.digest_of.cache_clear()


@pytest.mark.slow
def test_the_demonstrations_can_be_heard_by_every_engine() -> None:
    assert [clip.human is not None for clip in provenance.demos()] == [True, False]
    linear, again = provenance.digest_of("linear"), provenance.behaviour(["linear", "dtln-aec"])
    assert linear and again == {"linear": linear} and provenance.digest_of("linear-uncalibrated") != linear


def test_a_scenario_computes_in_one_thread_unless_more_are_asked_for() -> None:
    """With two threads of OpenBLAS, which wait for one another, a diagnosis took 11 s of CPU in place of 4."""
    code = "import os, sys, bench.__main__; print(os.environ['OMP_NUM_THREADS'], 'numpy' in sys.modules)"
    for given, expected in ({}, "1"), ({"OMP_NUM_THREADS": "2"}, "2"):
        environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"} | given
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=results.RESULTS.parents[1],
            capture_output=True,
            text=True,
            env=environment,
        )
        assert done.stdout.split() == [expected, "False"], "too late once numpy is loaded"
