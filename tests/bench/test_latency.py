"""The latency benchmark itself: what it times, and where it says that it was slow."""

from __future__ import annotations

import time

import numpy as np
import pytest

from bench import latency
from edgefilter.errors import UsageError


@pytest.fixture(scope="module")
def runs() -> dict[str, dict]:
    return {name: latency.run_hops(name, 0.5, paced=True) for name in ("ss", "aec3", "linear-learning")}


@pytest.mark.slow
def test_every_contender_is_timed_hop_by_hop_at_its_own_frame(runs: dict[str, dict]) -> None:
    for name, hop in (("ss", 256), ("aec3", 160)):
        row = latency.summary([runs[name], runs[name]])
        assert row["hop_ms"] == hop / 16 and row["hops"] == 2 * round(0.5 * 16000 / hop)
        assert 0 < row["p50"] <= row["p95"] <= row["p99"] <= row["max"]
        assert row["real_time_factor"] == pytest.approx(row["mean"] / row["hop_ms"])
        assert 20 < row["peak_memory_mb"] < 500


@pytest.mark.slow
def test_stages_add_up_to_less_than_the_whole_and_to_most_of_it(runs: dict[str, dict]) -> None:
    took, stages = np.array(runs["ss"]["took"]), runs["ss"]["stages"]
    assert set(stages) == {"alignment", "canceller", "residual", "analysis", "engine", "overlap-add"}
    # of the quickest quarter: what interrupts a hop can fall between stages
    quickest = np.argsort(took)[: took.size // 4]
    assert 0.5 < sum(np.array(times)[quickest].sum() for times in stages.values()) / took[quickest].sum() < 1.1


@pytest.mark.slow
def test_a_hop_is_timed_beside_a_learner_that_gets_it(runs: dict[str, dict]) -> None:
    learned = runs["linear-learning"]["learned"]
    assert learned["hops"] == 31 + 31 and learned["cpu_s"] > 0 and runs["ss"]["learned"] is None  # warm-up included


@pytest.mark.slow
def test_a_fresh_process_needs_more_than_its_hop_and_less_than_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latency, "STARTS", 1)
    assert 100 < latency.start_ms() < 60_000
    monkeypatch.setattr(latency, "BEGIN", "raise SystemExit")
    with pytest.raises(UsageError, match="no sound in a fresh process"):
        latency.start_ms()


def run(took: float, stages: dict[str, list[float]] | None = None, learned: dict | None = None) -> dict:
    return {
        "hop": 256,
        "took": [took] * 99 + [4 * took],
        "stages": stages or {},
        "peak_memory_mb": 70.0,
        "learned": learned,
    }


def test_the_slowest_hop_is_named_with_its_place_and_stage() -> None:
    quick = run(1.0, {"engine": [0.5] * 100, "alignment": [0.2] * 99 + [3.0]})
    worst = latency.slowest(quick)
    assert len(worst) == latency.SLOWEST
    assert worst[0] == {"second": pytest.approx(0.5 + 99 * 0.016, abs=0.016), "ms": 4.0, "stage": "alignment"}


def test_tables_compare_with_the_yardstick_and_with_the_engine_without_a_learner() -> None:
    learned = {"cpu_s": 0.16, "memory_mb": 80.0, "rounds": 3, "fell_behind": 1}
    found = {"linear": run(1.0), "linear-learning": run(2.0, learned=learned), "speexdsp": run(0.5)}
    rows = [{"contender": name, "paced": True, **latency.summary([one, one])} for name, one in found.items()]
    tables = {table["name"]: table for table in latency.tables(rows)}
    assert [row[-2:] for row in tables["latency"]["rows"]] == [[2.0, 2.0], [4.0, 4.0], [1.0, 1.0]]
    ((name, ratio, cpu_s, memory, fits, behind),) = tables["learner"]["rows"]
    assert (name, ratio, memory, fits, behind) == ("linear-learning", 2.0, 80.0, 3.0, 2)
    assert cpu_s == pytest.approx(0.32 / (200 * 0.016 / 60))


def test_pacing_waits_for_each_hop_and_is_not_counted() -> None:
    quiet = latency.Contender(256, lambda mic, ref: None)
    began = time.perf_counter()
    took = latency.measure(quiet, 0.3, paced=True)
    assert time.perf_counter() - began >= 18 * 0.016 and np.median(took) < 8.0  # half a hop
