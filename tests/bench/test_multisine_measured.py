"""The page of bench/measure/multisine.py counts what its rows say."""

from __future__ import annotations

from bench.measure.multisine import Row, page


def row(robot: int, found: float, names_sweep: list[str], names: list[str]) -> Row:
    verdicts = ["missing" if said else "explained" for said in (names_sweep, names)]
    return Row(robot, "plain", -3.0, -20.0, found, 0.4, 2.0, names_sweep, verdicts[0], 0.1, names, verdicts[1])


def test_errors_and_false_alarms_are_those_of_the_rows() -> None:
    rows = [row(0, -21.0, ["speaker_nonlinearity"], []), row(1, -19.5, ["rattle"], []), row(2, -20.0, [], ["rattle"])]
    text = page(rows)
    assert "off by 0.5 dB in the mean" in text and "at most 1.0" in text
    assert "2 of 3 with the sweep, 1 of 3 with multisines" in text
    assert "| 0 | plain | -3.0 | -20.0 | -21.0 | 0.4 | 2.0 | missing: speaker_nonlinearity | 0.1 | explained |" in text
