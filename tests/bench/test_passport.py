"""`python -m bench passport`: what is predicted on one recording is held against other humans on it, or on the next one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile as sf

from bench import __main__ as program
from bench import results
from edgefilter.report.passport import ERROR_DB
from tests.bench.conftest import RATE, babble


@pytest.fixture(scope="module")
def devices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One recording of the device x, and three of the device y."""
    folder = tmp_path_factory.mktemp("devices")
    for seed, name in enumerate(("x_farend", "y_00", "y_01", "y_02", "z_nearend")):
        said = babble(12.0, 40 + seed)
        sf.write(folder / f"{name}_lpb.wav", said, RATE)
        heard = 0.3 * np.roll(said, 500) + 1e-3 * np.random.default_rng(seed).standard_normal(said.size)
        sf.write(folder / f"{name}_mic.wav", heard, RATE)
    return folder


@pytest.mark.slow
def test_the_error_is_that_of_humans_on_the_same_device(devices: Path, clips: Path, tmp_path: Path) -> None:
    words = ["passport", devices, "--speech", clips, "--engines", "bypass,linear", "--levels=-10"]
    assert program.main([*map(str, words), "--output", str(tmp_path / "p")]) == 0
    (part,) = results.read(tmp_path / "p.json")["parts"].values()
    rows = part["rows"]
    assert {row["recording"] for row in rows} == {"x_farend", "y_01", "y_02"} and len(rows) == 3 * 2 * 2
    for row in rows:
        if row["engine"] == "bypass":
            assert row["predicted"] == pytest.approx(row["level"], abs=1.0)  # human and robot are nearly uncorrelated
            assert row["measured"] == pytest.approx(row["level"], abs=1.0)
        else:
            assert min(row["predicted"], row["measured"]) > row["level"] + 5
    tables = {one["name"]: one["rows"] for one in part["tables"]}
    errors = [row["predicted"] - row["measured"] for row in rows]
    assert tables["error"][-1][:3] == ["humans", "all", len(rows)]
    assert np.allclose(tables["error"][-1][3:], [np.median(np.abs(errors)), np.abs(errors).max(), np.mean(errors)])
    assert [row[:3] for row in tables["devices"]] == [
        [device, engine, humans] for device, humans in (("x", 2), ("y", 4)) for engine in ("bypass", "linear")
    ]


@pytest.mark.slow
def test_recordings_without_a_robot_alone_are_said_in_one_line(
    devices: Path, clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in devices.glob("z_*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    assert program.main(["passport", str(tmp_path), "--speech", str(clips)]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "no recording of a robot alone" in said


def test_the_error_that_the_page_states_is_the_one_measured() -> None:
    part = results.read(results.RESULTS / "passport.json")["parts"]["passport"]
    rows = next(table for table in part["tables"] if table["name"] == "error")["rows"]
    assert ERROR_DB == next(
        (round(median, 1), round(worst, 1)) for of, by, _, median, worst, _ in rows if (of, by) == ("humans", "all")
    )
