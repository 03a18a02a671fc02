"""One system on recordings of real devices in one line of figures."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

IN_TIME_S = 0.3
"""Somebody who interrupts is to be noticed by then."""
LOW_SER, WARM_S = -20.0, 5.0
"""The summary's cases: human at most at this level against the echo, after at least so many seconds of robot alone."""


def summarise(rows: list[dict]) -> dict:
    """What was measured of one system, None where nothing was."""
    double = [row for row in rows if row["part"] == "pairs" and row["kind"] == "doubletalk"]
    laid = [row for row in rows if row["part"] == "laid" and row["before"] >= WARM_S]
    hard = [row for row in laid if row["ser"] <= LOW_SER and not row["fan"]]
    ratios = [row["si_sdr"] for row in hard]
    return {
        "echo_mos": mean(row["echo_mos"] for row in double),
        "human_mos": mean(row["human_mos"] for row in double),
        "cases": len(hard),
        "si_sdr": mean(ratios),
        "si_sdr_std": float(np.std(ratios)) if ratios else None,
        "si_sdr_worst": min(ratios, default=None),
        "below_microphone": sum(row["si_sdr"] < row["si_sdr_mic"] for row in hard),
        "wer_capped": mean(row.get("wer_capped") for row in hard),
        "excess_db": max((row["excess_db"] for row in rows), default=None),
        "in_time": mean(in_time(row) for row in laid if row["ser"] == LOW_SER and "early" in row),
        **_alone([row for row in rows if row["part"] == "alone"]),
    }


def _alone(rows: list[dict]) -> dict:
    erles, starts = seconds(rows), [row["false_starts"] for row in rows if row["false_starts"] is not None]
    return {
        "erle_median": float(np.median(erles)) if erles else None,
        "erle_p10": float(np.quantile(erles, 0.1)) if erles else None,
        "false_starts": sum(starts) if starts else None,
        "alone_s": sum(row["seconds"] for row in rows),
    }


def mean(values: Iterable[float | None]) -> float | None:
    """Of those that are not None; None without any."""
    found = [value for value in values if value is not None]
    return float(np.mean(found)) if found else None


def seconds(alone: list[dict]) -> list[float]:
    """ERLE of every second in which the robot talks."""
    return [value for row in alone for value in row["erle_db"] if value is not None]


def in_time(row: dict) -> float:
    """1 where a laid human was noticed within IN_TIME_S, 0 where not."""
    return float(row["delay_s"] is not None and row["delay_s"] <= IN_TIME_S)
