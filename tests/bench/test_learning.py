"""The benchmark of learning: the day and the rooms that it simulates, and its three programs on the least that they take."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from bench.measure import latency, learning, learning_cost, learning_curve
from bench.simulate import robot_day
from bench.simulate.conversations import read_clips
from bench.simulate.robot_rooms import Recording
from bench.simulate.simulated_robot import Room, draw_robot, draw_walls, stand
from tests.bench.conftest import RATE, babble
from tests.bench.test_programs import check_stamp
from tests.bench.test_programs import run as run_program


def run(monkeypatch: pytest.MonkeyPatch, output: Path, program: str, *arguments: object) -> tuple[dict, str]:
    """The JSON content and the page of a program."""

    class Program:
        @staticmethod
        def main() -> int:
            sys.argv.insert(1, program)
            return learning.main()

    return run_program(monkeypatch, Program, output, *arguments)


def test_clips_repeat_only_after_all_were_said(clips: Path) -> None:
    repertoire = robot_day.Repertoire(np.random.default_rng(0), read_clips(clips, (1.0, 15.0)))
    said = [next(repertoire) for _ in range(9)]
    assert len({x.tobytes() for x in said[:6]}) == 6
    assert repertoire.speech_s == pytest.approx(sum(x.size for x in said) / RATE)
    assert repertoire.distinct_s == pytest.approx(sum(x.size for x in said[:6]) / RATE)


def test_an_utterance_is_heard_after_the_lag_at_its_volume_and_by_its_clock() -> None:
    robot = draw_robot(np.random.default_rng(3))
    response = np.eye(1, 100)[0]

    def echo(**how: float) -> np.ndarray:
        stage = robot_day.Stage("", Room(0.2, response, response), **{"lag": 800, **how})
        voice = iter([babble(3.0, 1).astype(float)])
        return robot_day.speak(np.random.default_rng(0), robot, voice, stage, 1.0)[1]

    plain = echo()
    assert not plain[: RATE // 2 + 800 + robot.bulk - 40].any() and plain.any()
    assert np.allclose(echo(lag=1000)[200:], plain)
    assert np.std(echo(volume_db=-20.0)) == pytest.approx(0.1 * np.std(plain), rel=0.05)  # the driver is not linear
    span = slice(40_000, 48_000)
    late = np.argmax(np.correlate(echo(ppm=-1000.0)[span], plain[span], "full")) - 7999
    assert late == pytest.approx(44, abs=4)  # 1000 ppm of 40000 to 48000 samples


def test_a_robot_driven_elsewhere_stays_in_its_room() -> None:
    rng, direction = np.random.default_rng(1), np.array([0.6, 0.0, -0.8])
    walls = draw_walls(rng, "lab")
    here, there = (stand(rng, walls, 0.2, direction, 1.2) for _ in range(2))
    assert here.rt60_s == pytest.approx(there.rt60_s, rel=0.15) and not np.allclose(here.robot[:800], there.robot[:800])
    assert np.argmax(np.abs(here.robot)) == np.argmax(np.abs(there.robot))  # its loudspeaker went along


def test_a_day(clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_day, "END_S", 1.0)
    folders = ("--voices", clips, "--speech", clips)
    found, page = run(monkeypatch, tmp_path / "day", "day", *folders, "--minutes", 0.1)
    check_stamp(found, page, ["ROBOT", "HUMAN"])
    assert found["speech_minutes"] == pytest.approx(found["distinct_minutes"])  # six clips, six stages
    begins = [stage["begin_s"] for stage in found["stages"]]
    assert len(begins) == 6 and begins[0] == 0 and begins == sorted(begins)
    for start, both in found["runs"].items():
        alone, with_learning = (np.array(both[way]["left_db"]) for way in ("alone", "learning"))
        assert alone.size == with_learning.size == len(found["speaking"]) == int(60 * found["minutes"])
        worst = found["louder"][start]
        assert worst["most_db"] == pytest.approx((with_learning - alone).max(), abs=0.002)
        assert worst["above_0.5_db"] == int(np.sum(with_learning - alone > 0.5))
        assert f"| {start} | {worst['most_db']:.2f} dB | {worst['at_s']} s |" in page
        assert abs(np.median(alone[~np.array(found["speaking"])])) < 3  # the fan alone
    first = np.array(found["runs"]["calibrated"]["alone"]["left_db"])[:3]
    assert first.max() < -robot_day.FAN_DB - 8  # the robot is 31.5 dB over the fan and largely cancelled
    assert (tmp_path / "day.png").stat().st_size > 10_000


def test_a_curve(clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning_curve, "YESTERDAY_S", 5.0)
    options = ("--voices", clips, "--rooms", 1, "--seconds", 6)
    found, page = run(monkeypatch, tmp_path / "curve", "curve", *options)
    check_stamp(found, page, ["ROBOT"])
    (row,) = found["rows"]
    curves = row["curves"]
    assert row["room"] == "lab" and list(curves) == list(learning_curve.SYSTEMS)
    assert curves["learning from nothing"][-1] < curves["cold"][-1] - 2
    assert row["remembered"]["same room"] and curves["next day, same room"][0] < curves["cold"][0] - 3
    assert f"| cold | {np.mean(curves['cold'][1:3]):.1f} (" in page and "Mean of 1 laboratories" in page
    assert (tmp_path / "curve.png").stat().st_size > 10_000


def test_what_is_left_is_measured_against_the_echo_without_the_fan() -> None:
    echo, fan = babble(4.0, 1), 0.01 * babble(4.0, 2)
    recording = Recording(echo, echo, fan)
    assert learning_curve.left(recording, recording.mic) == pytest.approx(0.0, abs=0.01)
    assert learning_curve.left(recording, fan + 0.1 * echo) == pytest.approx(-20.0, abs=0.01)


def test_cost_compares_the_same_engine_with_and_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    order = []

    def run_hops(engine: str, seconds: float, paced: bool, learning: bool) -> dict:
        order.append((engine, learning))
        learned = {"cpu_s": 2.0, "memory_mb": 80.0, "rounds": 3, "fell_behind": 0}
        took = [1.0] * 99 + [4.0 if learning else 2.0] * 2
        return {"hop": 256, "took": took, "learned": learned if learning else None}

    monkeypatch.setattr(learning_cost, "run_hops", run_hops)
    options = ("--engines", "linear,ss", "--seconds", 5, "--rounds", 2)
    found, page = run(monkeypatch, tmp_path / "cost", "cost", *options)
    check_stamp(found, page, [])
    assert order[4:] == order[:4][::-1] and len(set(order)) == 4
    assert [row["p99_ratio"] for row in found["rows"]] == [2.0, 2.0]
    assert found["rows"][0]["cpu_s_per_minute"] == [24.0, 24.0]
    assert "| linear | learning | 1.00 | 1.00 | 4.00 | 4.00 | 0 |" in page
    assert "| ss | 2.00 (2.00 to 2.00) | 24.0 | 80 | 3.0 | 0 |" in page
    assert (tmp_path / "cost.png").stat().st_size > 10_000


def test_a_hop_is_timed_beside_a_learner_that_hears_it() -> None:
    found = latency.run_hops("linear", 1.0, paced=True, learning=True)
    assert len(found["took"]) == 62
    assert found["learned"]["hops"] == 62 + 31 and found["learned"]["cpu_s"] > 0 and found["learned"]["memory_mb"] > 20
    assert latency.run_hops("linear", 0.2, paced=True)["learned"] is None
