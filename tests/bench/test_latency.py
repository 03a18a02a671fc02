"""The latency and soak benchmarks judged by themselves: what they time, where they say it was slow, what they call a drift."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from bench.measure import latency, latency_live, latency_report, soak
from bench.measure import latency_hops as hops


@pytest.fixture(scope="module")
def rows() -> list[dict]:
    return latency.matrix(["ss", "aec3"], 0.5, 2, (1,), (False,))


def test_every_contender_is_timed_hop_by_hop_at_its_own_frame(rows: list[dict]) -> None:
    assert [(row["contender"], row["paced"], row["hop"]) for row in rows] == [
        (name, paced, hop) for paced in (False, True) for name, hop in (("ss", 256), ("aec3", 160))
    ]
    for row in rows:
        assert row["hops"] == 2 * round(0.5 * 16000 / row["hop"])
        quantiles = list(row["quantiles"].values())
        assert 0 < quantiles[0] and quantiles == sorted(quantiles)
        assert row["real_time_factor"] == pytest.approx(row["mean"] / (row["hop"] / 16))


def test_stages_add_up_to_less_than_the_whole_and_to_most_of_it(rows: list[dict]) -> None:
    stages = rows[0]["stages"]
    assert set(stages) == {"alignment", "canceller", "residual", "analysis", "engine", "overlap-add"}
    parts = sum(
        part["quantiles"]["50"] for part in stages.values()
    )  # medians, since what interrupts a hop can fall between stages
    front = rows[0]["front"]
    assert front["hops"] == rows[0]["hops"] and front["mean"] == pytest.approx(
        stages["alignment"]["mean"] + stages["canceller"]["mean"]
    )
    assert 0.5 * rows[0]["quantiles"]["50"] < parts < 1.1 * rows[0]["quantiles"]["50"]


def test_the_page_and_the_picture_are_made(rows: list[dict], tmp_path: Path) -> None:
    curve = latency.curves(["ss"], 0.3, (2048,), (512,), ())
    assert curve["hop"][0]["hop"] == 512 and curve["tail"][0]["x"] == 2048
    starts = {"ss": [{"seconds": 0.5, "memory_mb": 70.0}]}
    result = {
        "conditions": {"cores": "2 of 2"},
        "seconds": 0.5,
        "rounds": 2,
        "missing": {"crnn": "no model"},
        "rows": rows,
        "curves": curve,
    }
    result |= {"start": starts, "click": {latency_live.ALONE: [100.0, float("nan")], "ss": [140.0, 150.0]}}
    page = latency_report.markdown(json.loads(json.dumps(result)), "latency")
    rows_found = ("| ss | 16 | idle | 1 | paced |", "| aec3 | 10 |", "| ss | 145 | 140 - 150 | +45 |")
    for words in (*rows_found, "crnn is not in the table: no model", "real-time factor", "alignment and canceller"):
        assert words in page
    latency_report.draw(result | {"rows": [*rows, *({**row, "busy": True} for row in rows)]}, tmp_path / "latency")
    assert (tmp_path / "latency.png").stat().st_size > 10_000


def test_the_slowest_hop_is_named_with_its_place_and_stage() -> None:
    quick = {"hop": 256, "took": [1.0] * 100, "stages": {"engine": [0.5] * 100, "alignment": [0.2] * 100}}
    quick["took"][40], quick["stages"]["alignment"][40] = 9.0, 8.0
    worst = latency.slowest(quick)
    assert len(worst) == 10
    assert worst[0] == {
        "second": pytest.approx(0.5 + 40 * 0.016, abs=0.016),
        "ms": 9.0,
        "stage": "alignment",
        "stage_ms": 8.0,
    }


def test_pacing_waits_for_each_hop_and_is_not_counted() -> None:
    quiet = hops.Contender(256, lambda mic, ref: None)
    began = time.perf_counter()
    took = hops.measure(quiet, 0.3, paced=True)
    assert time.perf_counter() - began >= 18 * 0.016 and np.median(took) < 8.0  # half a hop


def test_busy_cores_are_busy_and_freed() -> None:
    with latency.load(True):
        time.sleep(0.3)
        started = _counting()
        assert len(started) == min(latency.CORES, len(os.sched_getaffinity(0)))
        spent = sum(_cpu_ticks(pid) for pid in started)
        time.sleep(0.5)
        assert sum(_cpu_ticks(pid) for pid in started) > spent, "they hold no core"
    assert not _counting()
    with latency.load(False):
        assert not _counting()
    with pytest.raises(RuntimeError), latency.load(True):
        raise RuntimeError
    assert not _counting()


def _counting() -> set[str]:
    """The children of this process that only count; one that has ended but was not waited for is one, too."""
    own = str(os.getpid()).encode()
    return {pid for pid in os.listdir("/proc") if pid.isdigit() and _stat(pid)[1:2] == [own] and _is_load(pid)}


def _is_load(pid: str) -> bool:
    return b"while True: pass" in _read(pid, "cmdline") or _stat(pid)[0] == b"Z"


def _stat(pid: str) -> list[bytes]:
    """State, parent and so on: the fields of proc_pid_stat(5) from the third on."""
    return _read(pid, "stat").rpartition(b")")[2].split()


def _cpu_ticks(pid: str) -> int:
    return int(_stat(pid)[11])


def _read(pid: str, file: str) -> bytes:
    try:
        return Path(f"/proc/{pid}/{file}").read_bytes()
    except OSError:
        return b""


def test_the_distance_between_two_clicks_is_exact() -> None:
    rng = np.random.default_rng(0)
    recording = rng.normal(0, 20, 48_000)
    for at, gain in ((10_000, 1.0), (12_345, 0.5), (14_690, 0.25)):
        recording[at : at + latency_live.CLICK] += gain * latency_live.click()
    assert latency_live.distance_ms(recording) == 1000 * 2345 / 16000
    assert np.isnan(latency_live.distance_ms(recording[:11_000]))


def test_start_of_the_program_is_timed_to_its_first_samples() -> None:
    found = latency_live.start("ss")
    assert 0.05 < found["seconds"] and 20 < found["memory_mb"] < 200


def test_one_minute_of_audio_does_not_drift(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        sys, "argv", ["soak.py", "--minutes", "1", "--engine", "ss", "--output", str(tmp_path / "soak")]
    )
    assert soak.main() == 0
    found = json.loads((tmp_path / "soak.json").read_text())
    assert found["samples_in"] == found["samples_out"] == 60 * 16000 and len(found["slices"]) == 20
    page = (tmp_path / "soak.md").read_text()
    assert "nothing drifted" in page and "(soak.png)" in page and (tmp_path / "soak.png").stat().st_size > 5_000


def test_the_lag_of_the_long_run_comes_back_unless_it_shall_grow() -> None:
    hours = 3600 * 16000 * np.arange(4)
    np.testing.assert_allclose(soak.ahead(hours, one_way=False), [0, 2880, 0, 2880])  # 50 ppm of an hour's samples
    np.testing.assert_allclose(soak.ahead(hours, one_way=True), [0, 2880, 5760, 8640])


def test_a_leak_lost_samples_and_slowing_down_are_found() -> None:
    def result(**changes: object) -> dict:
        slices = [
            {"seconds": 60 * i, "memory_mb": 60.0, "p50_ms": 1.0, "p99_ms": 2.0, "bypass_ms": 0.1} for i in range(20)
        ]
        return {"kind": "file", "samples_in": 100, "samples_out": 100, "lost": 0, "slices": slices, **changes}

    assert soak.judge(result()) == []
    assert soak.judge(result(samples_out=99)) == ["100 samples in, 99 out"]
    assert soak.judge(result(lost=3)) == ["3 samples lost"]
    assert soak.judge(result(not_finite=2)) == ["2 samples are no numbers"]
    assert soak.judge(result(diverged=1)) == ["the canceller diverged 1 times"]
    leaking, slowing, throttled, bimodal = result(), result(), result(), result()
    for number in range(20):
        for key in ("p50_ms", "bypass_ms"):
            throttled["slices"][number][key] *= 1 + 0.1 * number
        leaking["slices"][number]["memory_mb"] += number
        slowing["slices"][number]["p50_ms"] += 0.1 * number
        bimodal["slices"][number]["p50_ms"] = 1.6 if number % 2 == number // 10 else 1.0
    assert "memory grew by 17.0 MB" in soak.judge(leaking)[0]
    assert "in the second" in soak.judge(slowing)[0]
    live = result(kind="live")
    for number, part in enumerate(live["slices"]):
        part["learner_mb"] = 60.0 + 40.0 * (number > 0)  # it comes when it is called
    assert soak.judge(live) == [] and live["learner_growth_mb"] == 0.0
    for part in live["slices"][3::2]:
        part["learner_mb"] += 150.0  # within a round
    assert soak.judge(live) == []
    for part in live["slices"][15:]:
        part["learner_mb"] += 60.0
    assert soak.judge(live) == ["the learner's memory grew by 60.0 MB"]
    assert soak.judge(bimodal) == []  # the robot spoke in five slices of one half and in four of the other
    assert soak.judge(throttled) == []  # the machine became slower, not the filter
