"""The guard on text, measured: its curves and its table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.measure import selfecho


def row(who: str, text: float, both: float | None = None, heard: str = "words") -> dict:
    found = {"system": "crnn", "who": who, "heard": heard, "probability": both, "text": text, "both": both}
    return found | ({"repeating": 1.0, "repeating_both": both} if who == "human" else {})


def test_a_guard_that_tells_all_has_an_area_of_one_and_one_that_knows_nothing_a_half() -> None:
    def area(robot: list[float], human: list[float]) -> float:
        x, y = np.array(selfecho.points(robot, human)).T
        return float(np.sum(np.diff(x) * (y[1:] + y[:-1])) / 2)

    assert area([0.9, 0.8], [0.1, 0.0]) == 1.0
    assert area([0.5, 0.5], [0.5]) == 0.5
    assert area([0.1], [0.9, 0.8]) == 0.0
    assert area([0.9, 0.1], [0.5]) == 0.5


def test_passages_in_which_nothing_was_heard_have_no_score(tmp_path: Path) -> None:
    rows = [row("robot", 0.9, 0.99), row("robot", 0.0, 0.9, heard=" "), row("human", 0.6, 0.1), row("human", 0.0, 0.01)]
    found = selfecho.summarise(rows)
    text = found["crnn"]["text"]
    assert (text["robot"], text["robot_passages"], text["human"]) == (1, 2, 2)
    assert (text["robot_told"], text["human_taken"], text["area"]) == (1, 1, 1.0)
    assert found["crnn"]["both"]["human_taken"] == 0 and found["crnn"]["repeating"]["area"] == 0.0
    page = selfecho.markdown(found, "guard.png")
    assert "| crnn | text | 1 of 2 | 1 | 2 | 1 | 1.00 |" in page
    selfecho.draw(found, tmp_path / "guard")
    assert (tmp_path / "guard.png").stat().st_size > 5000


def test_without_a_judge_of_speech_there_is_text_alone() -> None:
    found = selfecho.summarise([row("robot", 0.9), row("human", 0.1)])
    assert set(found["crnn"]) == {"text", "repeating"}
    assert selfecho.mean_probability([0.5, None], 256, slice(0, 512)) is None
    assert selfecho.mean_probability([0.0, 0.5, 1.0], 256, slice(256, 768)) == pytest.approx(0.75)
