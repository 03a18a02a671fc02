"""The judge of the diagnosis: counts, intervals, seals, and one real case through the whole loop."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from scipy import signal

from bench.measure import hidden_effects, hidden_scores
from bench.measure.hidden_scores import Outcome
from bench.simulate.hidden_robot import draw_scene
from edgefilter.errors import UsageError

RATE = 16000


def outcome(
    truth: str,
    verdict: str,
    *named: str,
    strength: str = "clear",
    excess_db: float = 5.0,
    sealed_hit: bool | None = None,
) -> Outcome:
    effects = tuple(truth.split("+")) if truth else ()
    numbers = (tuple(5.0 for _ in named), tuple(0.2 for _ in named), tuple(0.9 for _ in named))
    return Outcome(
        "c", effects, effects, strength, verdict, named, *numbers, excess_db, 0.2, "some words", 1.0, sealed_hit
    )


@pytest.mark.parametrize(
    ("hits", "n", "low", "high"), [(0, 100, 0.0, 0.0370), (9, 10, 0.5958, 0.9821), (10, 10, 0.7225, 1.0)]
)
def test_wilson_interval_against_the_textbook(hits: int, n: int, low: float, high: float) -> None:
    assert hidden_scores.wilson(hits, n) == pytest.approx((low, high), abs=1e-4)


@pytest.mark.parametrize(
    ("case", "hit", "label"),
    [
        (outcome("rattle", "missing", "rattle"), True, "rattle"),
        (outcome("rattle", "missing", "clock_drift", "rattle"), False, "clock_drift+rattle"),
        (outcome("rattle", "explained"), False, "none"),
        (outcome("none", "explained"), True, "none"),
        (outcome("none", "missing", "rattle"), False, "rattle"),
        (outcome("none", "unexplained"), False, "unknown"),
        (outcome("unknown", "unexplained", "bandlimit"), True, "unknown"),
        (outcome("unknown", "missing", "bandlimit"), False, "bandlimit"),
        (outcome("bandlimit+rattle", "missing", "rattle", "bandlimit"), True, "bandlimit+rattle"),
        (outcome("bandlimit+rattle", "missing", "rattle"), False, "rattle"),
        (outcome("", "missing", "rattle", sealed_hit=True), True, "rattle"),
        (outcome("", "missing", "rattle", sealed_hit=False), False, "rattle"),
        (outcome("none", "error"), False, "error"),
    ],
)
def test_what_counts_as_a_hit(case: Outcome, hit: bool, label: str) -> None:
    assert case.hit is hit and case.label == label


def test_summary_counts_by_strength_and_group() -> None:
    cases = [
        *(outcome("rattle", "missing", "rattle"), outcome("rattle", "missing", "mic_agc", "rattle")),
        outcome("bandlimit", "explained", strength="near"),
        *(outcome("none", "explained"), outcome("none", "missing", "rattle")),
        *(
            outcome("unknown", "explained"),
            outcome("unknown", "explained", excess_db=0.5),
            outcome("unknown", "unexplained"),
        ),
        outcome("bandlimit+rattle", "missing", "rattle", "bandlimit", "mic_agc"),
    ]
    summary = hidden_scores.summarise(cases)
    counts = {name: (count["hits"], count["n"]) for name, count in summary["counts"].items()}
    assert counts == {
        "top-1": (1, 3),
        "top-1, clear": (1, 2),
        "top-2, clear": (2, 2),
        "top-1, near": (0, 1),
        "top-2, near": (0, 1),
        "singles: that effect and no other": (1, 3),
        "false alarms on controls": (1, 2),
        "pairs: both named": (1, 1),
        "pairs: at least one named": (1, 1),
        "pairs: both and no other": (0, 1),
        "outside: unexplained": (1, 3),
        "outside: explained above 1 dB of excess": (1, 3),
    }
    assert summary["confusion"]["rattle"] == {"rattle": 1, "mic_agc": 1} and summary["confusion"]["none"] == {
        "none": 1,
        "rattle": 1,
    }
    assert not hidden_scores.glance({"made": summary})
    table = hidden_scores.glance({"made": summary, "again": hidden_scores.summarise(cases[-1:])})
    assert "|  | made | again |" in table and "| two: both named | 1 of 1 [21, 100] % | 1 of 1 [21, 100] % |" in table
    assert "| nothing: false alarms | 1 of 2 [9, 91] % |  |" in table and "sealed" not in table
    text = hidden_scores.markdown("made", cases, summary)
    assert (
        "| top-1, clear | 1 of 2 | 50 |" in text
        and "Misses (5)" in text
        and "| rattle | 1 of 2 | 5.0 | 0.2 | 0.2 | 90 |" in text
    )


@pytest.mark.parametrize(("label", "hit"), [("bandlimit+rattle", True), ("rattle", False)])
def test_seal_opens_for_the_exact_answer_only(label: str, hit: bool) -> None:
    seal = {"salt": "ab", "sha256": hashlib.sha256(f"ab:c:{label}".encode()).hexdigest()}
    assert hidden_effects.check_seal(outcome("", "missing", "rattle", "bandlimit"), seal).sealed_hit is hit


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One sealed control, 8 s long."""
    rng = np.random.default_rng(0)
    carrier = signal.sosfilt(
        signal.butter(2, [150, 5000], "band", fs=RATE, output="sos"), rng.standard_normal(8 * RATE)
    )
    x = carrier * np.abs(
        signal.sosfilt(signal.butter(2, 4.0, fs=RATE, output="sos"), rng.standard_normal(carrier.size))
    )
    x *= signal.windows.tukey(x.size, 0.2) * 0.8 / np.abs(x).max()
    scene = draw_scene(rng, x, 25.0)
    case = tmp_path_factory.mktemp("cases") / "c00"
    case.mkdir()
    for name, samples in (scene.signals | {"mic": scene.record(scene.usual)}).items():
        sf.write(case / f"{name}.flac", samples, RATE, subtype="PCM_16")
    seals = {"c00": {"salt": "s", "sha256": hashlib.sha256(b"s:c00:none").hexdigest()}}
    (case.parent / "seals.json").write_text(json.dumps(seals), encoding="utf-8")
    return case.parent


def test_whole_loop_on_a_sealed_control(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["hidden_effects.py", str(folder), "--output", str(tmp_path / "out")])
    assert hidden_effects.main() == 0
    result = json.loads((tmp_path / "out.json").read_text())
    case = result["cases"][folder.name][0]
    assert case["case"] == "c00" and case["truth"] == [] and case["excess_db"] < 1.0
    assert case["sealed_hit"] is (case["verdict"] == "explained")
    assert "| sealed: exact label |" in capsys.readouterr().out


def test_folder_without_cases_or_labels_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no"):
        hidden_effects.find_cases(tmp_path, None)
    (tmp_path / "c00").symlink_to(folder / "c00")
    with pytest.raises(UsageError, match="neither a truth.json nor an entry"):
        hidden_effects.run(tmp_path, None, 1)


def test_limit_spreads_over_the_folder(tmp_path: Path) -> None:
    for i in range(10):
        (tmp_path / f"{i}").mkdir()
        (tmp_path / f"{i}" / "mic.flac").touch()
    assert [case.name for case in hidden_effects.find_cases(tmp_path, 3)] == ["0", "4", "9"]
