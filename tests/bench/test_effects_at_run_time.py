"""What `add` brings to the running filter is measured on robots that have the effect, and told as it was measured."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf

from bench.measure import effects_at_run_time
from bench.measure.effects_at_run_time import Row, verdict
from bench.simulate import effect_conversations
from bench.simulate.conversations import read_clips
from bench.simulate.hidden_catalogue import CATALOGUE
from edgefilter.echo.effects.catalogue import EFFECTS
from tests.bench.conftest import RATE, babble

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def voices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight clips of one voice: enough for a reference of 20 s."""
    folder = tmp_path_factory.mktemp("voice")
    for i in range(8):
        sf.write(folder / f"{i}.flac", babble(3.5, 20 + i), RATE)
    rows = [f"{i}.flac\ts0\t3.50\tsome words here" for i in range(8)]
    (folder / "transcripts.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


def test_the_human_comes_late_and_before_the_microphone(voices: Path) -> None:
    clips = read_clips(voices, (1.0, 15.0))
    scene = effect_conversations.make(5, "mic_clipping", 0, {"s0": clips}, clips)
    assert scene.effect == "mic_clipping" and scene.mic.shape == scene.ref.shape == scene.clean.shape
    assert np.abs(scene.clean[: scene.human.start]).max() < 1e-9  # rounding of a transform
    assert scene.early + 4 * RATE < scene.human.start
    late = np.abs(scene.mic[scene.human])
    assert np.sum(late > 0.97 * late.max()) > 50  # the sum with the human is limited
    assert np.abs(scene.ref[scene.early - 200 : scene.early + 200]).max() < 0.05 * np.abs(scene.ref).max()  # a pause


def test_a_fan_that_is_known_makes_it_better(voices: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["--voices", voices, "--speech", voices, "--count", 1, "--effects", "fan_noise"]
    arguments += ["--engines", "ss", "--output", tmp_path / "found", "--page", tmp_path / "page.md"]
    monkeypatch.setattr(sys, "argv", ["program", *map(str, arguments)])
    assert effects_at_run_time.main() == 0
    found = json.loads((tmp_path / "found.json").read_text())
    (row,) = found["rows"]
    assert row["erle_after"] > row["erle_before"] + 1  # as much fan more is masked, up to the mask's floor
    lines = (tmp_path / "page.md").read_text().splitlines()
    (told,) = [line for line in lines if line.startswith("| fan_noise |")]
    assert told in (tmp_path / "found.md").read_text() and told.endswith("| better |")


def test_worse_is_said() -> None:
    rows = [Row("rattle", "clear", "ss", 5.0, 5.0 - k / 10, 20.0, 22.0) for k in range(1, 9)]
    assert verdict(rows) == "worse"


def test_the_page_is_what_was_measured() -> None:
    """Every line of the tables in docs/ stands in the result, and every effect in the tables."""
    told = (ROOT / "docs/effects_at_run_time.md").read_text(encoding="utf-8").splitlines()
    measured = (ROOT / "bench/results/effects_at_run_time.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in told if line.startswith("| ") and not line.startswith("| effect ")]
    assert {line.split(" | ")[0].removeprefix("| ") for line in rows if line.count("|") > 5} >= set(CATALOGUE)
    assert set(CATALOGUE) <= {effect.name for effect in EFFECTS}
    assert [line for line in rows if line not in measured] == []
