"""The statistics of a comparison and a diagnosis as lines for the terminal and rows for the page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edgefilter.diagnosis.independence import Correlogram, Independence
from edgefilter.diagnosis.proof import Proof
from edgefilter.diagnosis.result import Candidate, Known, Precision
from edgefilter.report.words import UNITS, decibels, figure

SCALE = 1e4
"""Correlations stand in the page as whole numbers of 1e-4."""
WEIGHT, LIGHT = 0.01, "dependent, but less than 1 % of it"
"""Part of what is left that is worth a reason: half a minute shows what nobody would mend."""
HEADS = ("rank", "effect", "alone, dB", "beside, dB", "numbers", "Delta BIC", "verdict")


def independence_lines(found: Independence | None, what: str = "of what is left") -> list[str]:
    """How many correlations are beyond their bounds, and what that says; at most 80 columns."""
    if found is None:
        return []
    head = f"independence {what}: lags beyond their 99 % bounds, 1 % by chance"
    return [head] + [f"  {name:<17} {100 * part.outside:5.1f} %  {says}" for name, part, says in _judged(found)]


def candidate_lines(tried: Sequence[Candidate]) -> list[str]:
    """The table of all effects that were tried."""
    if not tried:
        return ["tried       nothing: no more of the robot's voice is left than of its silences"]
    widths = (4, 20, 9, 10, 7, 9)
    table = [HEADS, *(_cells(row) for row in tried)]
    cells = (
        [text.ljust(w) if column == 1 else text.rjust(w) for column, (text, w) in enumerate(zip(row, widths))]
        for row in table
    )
    return ["tried       by Delta BIC; gain on held-out samples"] + [
        f"  {' '.join(row)}  {whole[-1]}" for row, whole in zip(cells, table, strict=True)
    ]


def precision_lines(found: Precision) -> list[str]:
    """Each number with its standard error, then what they share."""
    if not found.numbers:
        return []
    width = max(len(known.label) for known in found.numbers)
    lines = ["known       number +/- standard error"]
    lines += [f"  {known.label:<{width}}  {error_text(known)}" for known in found.numbers]
    if found.correlations:
        lines.append("correlations of these")
        lines += [f"  {first}, {second}  {r:+.2f}" for first, second, r in found.correlations]
    return lines


def advice_lines(advice: Sequence[str]) -> list[str]:
    """What to record next."""
    return [f"to tell     {line}" for line in advice]


def error_text(known: Known) -> str:
    """Say "-3.00 +/- 0.004 dB (0.1 %)", and where the error is from unless from the prediction's derivatives."""
    unit = UNITS.get(known.unit, known.unit)
    if known.error is None:
        why = "at its bound" if known.source == "at its bound" else "no standard error: too few fits to tell"
        return f"{figure(known.value)} {unit}".rstrip() + f", {why}"
    share = known.error / abs(known.value) if known.value else 0.0
    part = f" ({100 * share:.2g} %)" if 0.0 < share < 1.0 else " (unknown: more than itself)" if share else ""
    by = ", from fits to thirds of the recording" if known.source == "thirds" else ""
    return f"{figure(known.value)} +/- {figure(known.error)} {unit}".rstrip() + part + by


def candidate_rows(tried: Sequence[Candidate]) -> dict[str, object]:
    """The table for the page; named: whether a row is to stand out."""
    return {
        "heads": HEADS,
        "rows": [{"cells": _cells(row), "named": row.verdict == "named"} for row in tried],
    }


def precision_rows(found: Precision) -> dict[str, object]:
    """Numbers and correlations for the page."""
    return {
        "numbers": [(known.label, error_text(known)) for known in found.numbers],
        "correlations": [(first, second, f"{r:+.2f}".replace("-", "−")) for first, second, r in found.correlations],
    }


def correlograms(found: Independence | None) -> dict[str, object] | None:
    """What the page draws of a residual's correlations, and says below."""
    if found is None:
        return None
    said = {name: f"{100 * part.outside:.1f} % of lags outside: {says}" for name, part, says in _judged(found)}
    auto, *zones = (f"{name}, {text}" for name, text in said.items())
    return {
        "auto": {**_drawn(found.autocorrelation), "says": [auto]},
        "cross": {**_drawn(found.cross_correlation), "says": zones},
    }


def _judged(found: Independence) -> list[tuple[str, Correlogram, str]]:
    """Name, correlogram and judgement: of the autocorrelation, then of each range of lags behind the direct sound."""
    auto = found.autocorrelation
    at = auto.lags_ms[auto.largest]
    rows = [("autocorrelation", auto, f"not white, furthest at {at:.1f} ms" if auto.dependent else "white")]
    for zone in found.zones:
        heavy = f"{100 * zone.share:.0f} % of it: {zone.meaning}"
        says = (heavy if zone.share >= WEIGHT else LIGHT) if zone.part.dependent else "independent"
        rows.append((f"{zone.low_ms:g} to {zone.high_ms:g} ms", zone.part, says))
    return rows


def _drawn(part: Correlogram) -> dict[str, object]:
    step = float(part.lags_ms[1] - part.lags_ms[0])
    arrays = {
        name: np.round(SCALE * getattr(part, name)).astype(int).tolist() for name in ("values", "expected", "bounds")
    }
    return {"from_ms": float(part.lags_ms[0]), "step_ms": step, **arrays}


def _cells(row: Candidate) -> tuple[str, ...]:
    def shown(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"

    verdict = row.verdict + (f": {row.why}" if row.why else "")
    rank = "-" if row.rank is None else str(row.rank)
    gains = (shown(row.gain_db, 2), shown(row.beside_db, 2))
    return (rank, row.effect, *gains, shown(row.numbers, 0), shown(row.delta_bic, 0), verdict)


def proof_line(proof: Proof | None, unproven: str) -> str:
    """What the running filter made of what was found, or why it was not asked."""
    if proof is None:
        return f"proof       none: {unproven}"
    return (
        f"proof       running filter, {proof.seconds:.1f} s held out: ERLE {decibels(proof.erle_before_db)} dB before,"
        f" {decibels(proof.erle_after_db)} dB after"
    )
