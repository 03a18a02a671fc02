"""One system on recordings of real devices in one line of figures."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from bench.measure.real_barge_in import THRESHOLDS, in_time

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
        "si_sdr_std_level": spread_at_one_level(hard),
        "si_sdr_worst": min(ratios, default=None),
        "below_microphone": sum(row["si_sdr"] < row["si_sdr_mic"] for row in hard),
        "wer_capped": mean(row.get("wer_capped") for row in hard),
        "excess_db": max((row["excess_db"] for row in rows), default=None),
        "in_time": mean(in_time(row) for row in laid if row["ser"] == LOW_SER and "early" in row),
        "curve": curve(rows),
        **_alone([row for row in rows if row["part"] == "alone"]),
    }


def _alone(rows: list[dict]) -> dict:
    erles, starts = seconds(rows), [row["false_starts"] for row in rows if "false_starts" in row]
    return {
        "erle_median": float(np.median(erles)) if erles else None,
        "erle_p10": float(np.quantile(erles, 0.1)) if erles else None,
        "false_starts": sum(starts) if starts else None,
        "alone_s": sum(row["seconds"] for row in rows),
    }


def spread_at_one_level(rows: list[dict]) -> float | None:
    """Standard deviation of the SI-SDR about the mean of its own level of the human, dB; None without rows."""
    levels = [[row["si_sdr"] for row in rows if row["ser"] == ser] for ser in {row["ser"] for row in rows}]
    squares = sum(len(ratios) * np.var(ratios) for ratios in levels)
    return float(np.sqrt(squares / len(rows))) if rows else None


def mean(values: Iterable[float | None]) -> float | None:
    """Of those that are not None; None without any."""
    found = [value for value in values if value is not None]
    return float(np.mean(found)) if found else None


def seconds(alone: list[dict]) -> list[float]:
    """ERLE of every second in which the robot talks."""
    return [value for row in alone for value in row["erle_db"] if value is not None]


def curve(rows: list[dict]) -> list[dict]:
    """One system at each threshold of its probability: false starts an hour, and the share noticed in time."""
    alone = [row for row in rows if row["part"] == "alone" and "curve" in row]
    laid = [row for row in rows if row["part"] == "laid" and "curve" in row]
    asked = [row for row in laid if row["ser"] == LOW_SER and row["before"] >= WARM_S]
    if not alone or not asked:
        return []
    hours = sum(row["seconds"] for row in alone) / 3600
    false, share = (np.array([row["curve"] for row in part], np.float64) for part in (alone, asked))
    points = zip(THRESHOLDS, false.sum(axis=0) / hours, share.mean(axis=0), strict=True)
    return [{"threshold": at, "false_an_hour": float(f), "in_time": float(s)} for at, f, s in points]
