"""A law that no listed effect has, written as an effect of the user's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edgefilter import add, compare, load_effect
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.diagnosis.write_effect import write_effect
from edgefilter.echo.effects import catalogue
from edgefilter.errors import EdgefilterError, UsageError
from tests.diagnosis.robot_scene import profile, record, voice


@pytest.fixture(scope="module")
def rectified() -> tuple[np.ndarray, np.ndarray]:
    """Recording and reference of a robot whose amplifier lets half of each wave through."""
    x = voice(8.0)
    half = np.maximum(x, 0.25 * x).astype(np.float32)
    return record(half), x


def test_add_takes_what_diagnose_wrote_and_the_error_falls(rectified, tmp_path: Path, monkeypatch) -> None:
    y, x = rectified
    monkeypatch.setattr(catalogue, "_known", dict(catalogue._known))
    found = diagnose(profile(), y, x)
    assert "one curve" in write_effect(tmp_path / "my_amplifier.py", profile(), found, y, x)
    text = (tmp_path / "my_amplifier.py").read_text(encoding="utf-8")
    assert "INPUT = np.array([" in text and len(text.splitlines()) < 45
    name = load_effect(tmp_path / "my_amplifier.py")
    knowing, before, after = add(profile(), name, y, x)
    assert dict(knowing.echo.effects)[name]["amount"] == pytest.approx(1.0, abs=0.05)
    assert before.excess_db > 5.0 and after.excess_db < 1.0
    assert compare(knowing, y, x).excess_db == pytest.approx(after.excess_db, abs=0.1)


def test_a_recording_that_is_explained_has_no_law_to_write(tmp_path: Path) -> None:
    x = voice(6.0)
    y = record(x)
    found = diagnose(profile(), y, x)
    with pytest.raises(EdgefilterError, match="explains anything of what the profile leaves: no effect is written"):
        write_effect(tmp_path / "mine.py", profile(), found, y, x)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["mine.txt", "my effect.py", "rattle.py"])
def test_a_name_that_no_effect_can_have_is_refused_before_any_work(name: str, rectified, tmp_path: Path) -> None:
    y, x = rectified
    with pytest.raises(UsageError, match="one word and no known effect's"):
        write_effect(tmp_path / name, profile(), None, y, x)
