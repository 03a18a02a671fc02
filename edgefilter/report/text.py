"""A comparison and a diagnosis as lines for the terminal: figures with small bars."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edgefilter.diagnosis.compare import Comparison
from edgefilter.diagnosis.diagnose import Diagnosis, Finding
from edgefilter.report.statistics import advice_lines, candidate_lines, independence_lines, precision_lines, proof_line
from edgefilter.report.words import decibels, headline, interval_text, sentence, title

BAR_WIDTH = 30
MAX_TIMES = 12
"""Rows that the excess by time takes at most; longer recordings are summed up in longer steps."""


def comparison_lines(found: Comparison) -> list[str]:
    """The excess, then where it is: by frequency, time, level and lag, while the robot is silent, and whether it is noise."""
    lines = [
        f"excess      {decibels(found.excess_db)} dB over the noise floor of {decibels(found.noise_floor_db)} dBFS",
        f"lag         {found.offset_samples:+.2f} samples against the calibration, taken out",
    ]
    if math.isfinite(found.silence_excess_db):
        lines.append(
            f"silence     {decibels(found.silence_excess_db)} dB over the noise floor while the robot is silent"
        )
    if found.human:
        spans = ", ".join(f"{start:.1f}-{end:.1f} s" for start, end in found.human)
        lines.append(f"human       somebody talks at {spans}; left out of every figure")
    lines += [f"WARNING     {text}" for text in found.warnings]
    lines += _table("by frequency", "Hz", found.bands)
    lines += _table("by time", "s", coarser(found.times, MAX_TIMES))
    lines += _table("by level of the robot's voice", "dBFS", found.levels)
    lines += ["by lag of the correlation with the reference"]
    lines += [
        f"  {low:5g} to {high:4g} ms  {100 * share:5.0f} %   {_bar(share)}".rstrip() for low, high, share in found.lags
    ]
    return lines + independence_lines(found.independence)


def diagnosis_lines(found: Diagnosis, calibrated: bool = True) -> list[str]:
    """The verdict in a sentence, the error budget step by step, each finding with its evidence, statistics, where the excess was.

    calibrated: False where the profile was made from the recording itself.
    """
    names = [finding.effect for finding in found.ranking]
    added = in_order(found.ranking)
    profile = "the profile as it is" if calibrated else "a stationary linear path"
    steps = [(profile, added[0].excess_before_db if added else found.comparison.excess_db)]
    steps += [(f"with {finding.effect}", finding.excess_after_db) for finding in added]
    top = max(1.0, *(db for _, db in steps))
    lines = [
        f"verdict     {found.verdict}: {headline(found.verdict, names, calibrated)}",
        "budget      dB over the noise floor",
    ]
    lines += [f"  {name:<27} {decibels(db):>6}  {_bar(db / top)}".rstrip() for name, db in steps]
    lines.append(
        f"  {'of it irreducible':<27} {decibels(found.irreducible_db):>6}  {_bar(found.irreducible_db / top)}".rstrip()
    )
    for rank, finding in enumerate(found.ranking, start=1):
        lines += _finding(rank, finding)
    if found.evidence:
        lines.append(f"left        {sentence(found.evidence)}")
    if found.proof or found.unproven:
        lines.append(proof_line(found.proof, found.unproven))
    lines += precision_lines(found.precision)
    if found.ranking:
        lines += independence_lines(found.independence, "with all that was found")
    lines += [*candidate_lines(found.tried), *advice_lines(found.advice)]
    return [*lines, f"where       it is with {profile}:", *comparison_lines(found.comparison)]


def add_command(effects: Sequence[str], names: Mapping[str, Any]) -> str:
    """What to type to have those effects in a new profile; without a profile, to have one at all."""
    if names["profile"] is None:
        return "edgefilter calibrate --live --output robot.npz"
    files = " ".join(f"--{role} {shlex.quote(str(names[role]))}" for role in ("profile", "recording", "reference"))
    own = "".join(f" --effects {shlex.quote(str(file))}" for file in names.get("effects") or ())
    output = Path(str(names["profile"])).with_suffix(f".{'.'.join(effects)}.npz")
    return f"edgefilter add {' '.join(effects)} {files}{own} --output {shlex.quote(str(output))}"


def in_order(ranking: Sequence[Finding]) -> list[Finding]:
    """The findings as one was added after the other, so that each starts where the one before it ended."""
    return sorted(ranking, key=lambda finding: -finding.excess_before_db)


def coarser(times: Sequence[tuple[float, float, float]], rows: int) -> list[tuple[float, float, float]]:
    """Neighbouring (start_s, end_s, excess_db) joined, powers averaged, so that at most `rows` remain."""
    step = math.ceil(len(times) / rows) if times else 1
    groups = [times[at : at + step] for at in range(0, len(times), step)]
    return [
        (group[0][0], group[-1][1], 10 * math.log10(np.mean([10 ** (db / 10) for _, _, db in group])))
        for group in groups
    ]


def _finding(rank: int, finding: Finding) -> list[str]:
    lines = [
        (
            f"{rank:>2}. {title(finding.effect)} ({finding.effect}): {decibels(finding.excess_before_db)} to"
            f" {decibels(finding.excess_after_db)} dB, {100 * finding.share:.0f} % of the excess"
        ),
        f"      {sentence(finding.evidence)}",
    ]
    return lines + [f"      {name} = {interval_text(interval)}" for name, interval in finding.parameters.items()]


def _table(heading: str, unit: str, rows: Sequence[tuple[float, float, float]]) -> list[str]:
    top = max([1.0, *(db for _, _, db in rows)])
    return [heading] + [
        f"  {low:5.4g} to {high:4.4g} {unit:<4} {decibels(db):>6} dB  {_bar(db / top)}".rstrip()
        for low, high, db in rows
    ]


def _bar(part: float) -> str:
    return "#" * round(BAR_WIDTH * min(max(part, 0.0), 1.0))
