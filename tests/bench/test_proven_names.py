"""What is named in a recording's first part is proven on its rest: by the running filter, and by the noise of the silences."""

from __future__ import annotations

import numpy as np
import pytest
import soundfile as sf

from bench.measure import proven_names
from bench.measure.proven_names import Row, examine, noise_off_db, summarise
from edgefilter.echo.model import EchoModel
from tests.diagnosis.robot_scene import FAN, path, profile, record, voice

RATE = 16000


def test_what_helps_the_filter_on_the_rest_is_kept() -> None:
    x = voice(9.0)
    elsewhere = EchoModel((0.8 * path(seed=5)).astype(np.float32))  # in the same room
    row = examine("moved", profile(), record(x, elsewhere), x)
    assert row.kept == ("early_path",)
    assert row.erle_db is not None and row.first_db == row.erle_db
    assert row.erle_db[1] > row.erle_db[0] + 2.0  # a filter that starts with the old path has to learn another


def test_a_louder_fan_is_proven_by_the_silences_of_the_rest() -> None:
    x = voice(16.0)
    louder = (record(x) + FAN * np.sqrt(3.0) * np.random.default_rng(8).standard_normal(x.size)).astype(np.float32)
    knowing = profile().echo.with_effect("fan_noise", {"spectrum_db": 6.0})
    before, after = noise_off_db(profile(), knowing, louder, x, 4 * RATE) or (0.0, 0.0)
    assert before == pytest.approx(6.0, abs=0.7) and after < 1.5  # a few frames


def test_a_recording_without_the_robot_is_declined() -> None:
    x = voice(6.0)
    noise = np.random.default_rng(1).standard_normal(x.size).astype(np.float32)
    row = examine("nobody", profile(), FAN * noise, x)
    assert "does not contain the reference" in row.declined
    assert row.erle_db is None


def test_falls_and_rises_are_counted_by_what_a_filter_may_differ_for_no_reason() -> None:
    rows = [
        Row("a", ("x",), ("x",), (10.0, 12.0), (10.0, 12.0)),
        Row("b", ("x", "y"), ("x",), (10.0, 9.0), (10.0, 10.1)),
        Row("c", ("z",), noise_db=(6.0, 1.0)),
        Row("d", declined="no robot: none"),
    ]
    summary = summarise(rows)
    assert (summary["recordings"], summary["declined"], summary["judged"]) == (4, 1, 2)
    assert (summary["named"]["fell"], summary["named"]["rose"], summary["named"]["worst_db"]) == (1, 1, -1.0)
    assert (summary["kept"]["fell"], summary["kept"]["rose"]) == (1, 0)
    assert summary["noise"] == {"proven": 1, "of": 1}
    page = proven_names.markdown("set", rows, summary)
    assert "rose in 1 (worst: -1.0 dB)" in page and "| d | declined: no robot |" in page


def test_a_joined_minute_is_cut_and_a_short_recording_is_not(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (("device_00", 60), ("short", 12)):
        for end in ("lpb", "mic"):
            sf.write(tmp_path / f"{name}_{end}.wav", np.zeros(seconds * RATE), RATE, subtype="PCM_16")
    monkeypatch.setattr(proven_names, "examine", lambda name, profile, y, x: (name, y.size, x.size))
    rows = list(proven_names.of_real(tmp_path, None))
    assert [row[0] for row in rows] == [f"device_00 from {at} s" for at in range(0, 60, 10)] + ["short"]
    assert {row[1] for row in rows[:6]} == {10 * RATE} and rows[6][1] == 12 * RATE
