"""Measuring programs run from their command lines to a stamped result, on the least that they take."""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf

from bench.measure import alignment, alone, apply, canceller, real_recordings, tune_paper_ss
from edgefilter.diagnosis.criteria import Criteria
from tests.bench.conftest import RATE, babble


def run(monkeypatch: pytest.MonkeyPatch, program: object, output: Path, *arguments: object) -> tuple[dict, str]:
    """The JSON content and the page."""
    monkeypatch.setattr(sys, "argv", ["program", "--output", str(output), *map(str, arguments)])
    assert not program.main()
    return json.loads(output.with_suffix(".json").read_text()), output.with_suffix(".md").read_text()


def check_stamp(found: dict, page: str, what: list[str]) -> None:
    assert [entry["what"] for entry in found["stamp"]["data"]] == what
    assert found["schema"] == 2 and page.startswith(f"# {found['title']}\n") and found["stamp"]["command"] in page


def test_one_alone(live: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("--conversations", live, "--every", 2, "--engines", "linear")
    found, page = run(monkeypatch, alone, tmp_path / "alone", *options)
    check_stamp(found, page, ["conversations"])
    (row,) = found["rows"]
    assert row["conversation"] == "lab_00" and row["human x 10"] > 60  # `linear` has nothing to subtract
    assert f"| linear | {row['human x 1']:.1f} ({row['human x 1']:.1f}) |" in page


def test_the_linear_stage(live: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, page = run(monkeypatch, canceller, tmp_path / "canceller", "--conversations", live)
    check_stamp(found, page, ["conversations"])
    assert [row["name"] for row in found["rows"]] == ["live/lab_00", "live/office_01"]
    assert all(row["erle_without_human_db"] > 5 for row in found["rows"])  # the filter removes the robot in both
    assert page.count("| lab | warm | ") == page.count("| office | cold | ") == 1
    assert (tmp_path / "canceller.png").stat().st_size > 5000


def test_alpha_with_the_fewest_word_errors_is_chosen(
    live: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Listener:
        """Understands everything at the third of three alphas."""

        def __init__(self, folder: Path, cache: Path) -> None:
            self.heard = 0

        def transcribe(self, samples: np.ndarray) -> str:
            self.heard += 1
            return "some words here" if self.heard > 4 else ""

    monkeypatch.setattr(tune_paper_ss, "Recogniser", Listener)
    monkeypatch.setattr(tune_paper_ss, "ALPHAS", (1.0, 2.0, 4.0))
    options = ("--conversations", live, "--whisper", live)
    found, page = run(monkeypatch, tune_paper_ss, tmp_path / "tune", *options)
    check_stamp(found, page, ["conversations"])
    assert found["alpha"] == 4.0 and len(found["rows"]) == 6
    assert "alpha 4." in page and "WHISPER" in found["stamp"]["models"]


def test_real_recordings_without_an_echo_are_declined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "pairs"
    folder.mkdir()
    for name, seed in (("lpb", 1), ("mic", 2)):
        sf.write(folder / f"one_{name}.wav", babble(6.0, seed), RATE)
    found, page = run(monkeypatch, real_recordings, tmp_path / "real", "--recordings", folder)
    check_stamp(found, page, ["RECORDINGS"])
    row = found["results"]["one"]
    assert row["verdict"] == "declined" and row["measured_s"] == 4.0 and abs(row["linear_db"]) < 3
    assert "DIR holds pairs NAME_lpb.wav" in page and "| one | declined |  |  | 4.0 s of everything |" in page


def test_alignment_and_its_cost_measured_later(clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alignment, "JUMPS", (40, 1500))
    monkeypatch.setattr(alignment, "TIMED", 1)
    folders = ("--voices", clips, "--speech", clips)
    sizes = ("--count", 1, "--minutes", 1, "--false-minutes", 0, "--repeats", 1, "--seed", 7)
    found, page = run(monkeypatch, alignment, tmp_path / "alignment", *folders, *sizes)
    check_stamp(found, page, ["ROBOT", "HUMAN"])
    assert {name: len(block["rows"]) for name, block in found["lags"].items()} == {"profile": 3, "no profile": 3}
    assert found["cost"]["stamp"] == found["stamp"] and "Cost per hop of 256" in page
    assert (tmp_path / "alignment.png").stat().st_size > 10_000
    again, _ = run(monkeypatch, alignment, tmp_path / "alignment", *folders, "--only-cost", "--seed", 7)
    assert again["stamp"] == found["stamp"] and again["lags"] == found["lags"]
    assert "--only-cost" in again["cost"]["stamp"]["command"]


def test_what_the_first_seconds_teach(live: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("--room", "lab", "--engines", "linear")
    cut_short = partial(apply.diagnose, criteria=Criteria(most_cost=4))  # what a search finds is tested elsewhere
    monkeypatch.setattr(apply, "diagnose", cut_short)
    monkeypatch.setattr(sys, "argv", ["program", str(live), "--output", str(tmp_path / "apply"), *options])
    assert not apply.main()
    found, page = json.loads((tmp_path / "apply.json").read_text()), (tmp_path / "apply.md").read_text()
    check_stamp(found, page, ["CONVERSATIONS"])
    (row,) = found["conversations"]
    assert row["conversation"] == "lab_00" and set(row["si_sdr"]) == set(apply.PROFILES)
    proofs = found["summary"]["live, lab"]["proofs"]
    assert proofs["added"]["proofs"] == 1 and proofs["added"]["refused"] == row["worse"]["added"]
    assert "| profile | linear |" in page and page.count("| `diagnose --apply` |") == 2
