"""A comparison and a diagnosis as text: sentences and figures, and lines for the terminal."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edgefilter.diagnosis.compare import Comparison
from edgefilter.diagnosis.independence import Correlogram, Independence
from edgefilter.diagnosis.ordinary import percent
from edgefilter.diagnosis.proof import Proof
from edgefilter.diagnosis.result import Candidate, Diagnosis, Finding, Interval, Known, Precision, in_order
from edgefilter.echo.effects.catalogue import find, names

UNITS = {"1": "", "1e-6": "ppm"}
"""How a parameter's unit is printed, where that differs from its name."""
WEIGHT = 0.01
"""Least share of the residual's power for which the text names the cause of a dependence. Half a minute of sound also shows
smaller dependences, which nobody would correct."""
LINES = 10
"""Of a comparison or a diagnosis as the command prints it without --verbose: with the command typed before it half of a terminal."""
MORE = "more        --verbose: all figures; --report PAGE.html: pictures and sound"
IRREDUCIBLE = "noise, whose waveform nothing predicts"
CALIBRATE = "edgefilter calibrate --live --output robot.npz"
HEADS = ("rank", "effect", "alone, dB", "added, dB", "verdict")


def spoken(effect: str) -> str:
    """Name an effect inside a sentence.

    An effect without a title, or one whose file is not loaded, has its own name, without underscores.
    """
    return (find(effect).title if effect in names() else "") or effect.replace("_", " ")


def title(effect: str) -> str:
    """Name an effect in a heading, without its article."""
    words = spoken(effect).removeprefix("a ")
    return words[:1].upper() + words[1:]


def joined(words: Iterable[str]) -> str:
    """Join words as in "a, b and c"."""
    *first, last = list(words) or [""]
    return f"{', '.join(first)} and {last}" if first else last


def sentence(words: str) -> str:
    """Make a sentence of the words: a capital letter begins it, a full stop ends it."""
    words = words.strip()
    return words and words[:1].upper() + words[1:] + ("" if words.endswith((".", "!", "?")) else ".")


def headline(verdict: str, effects: Iterable[str], calibrated: bool = True) -> str:
    """Say the verdict of a diagnosis in a sentence or two.

    calibrated: False where the recording itself made the profile, which then cannot lack anything.
    """
    found = joined(spoken(effect) for effect in effects)
    if verdict == "missing" and not calibrated:
        return f"The recording shows more than a stationary linear path: {found}."
    if verdict == "explained" and not calibrated:
        return "A stationary linear path explains this recording. Only a calibration can tell which effects this path contains."
    if verdict == "missing":
        return f"The recording differs from the profile by {found}."
    if verdict == "explained":
        return "The profile explains this recording."
    beside = f" beside {found}" if found else ""
    return f"This recording contains something{beside} that no known effect explains."


def decibels(value: float) -> str:
    """Format a value in dB with one decimal; zero has no minus sign."""
    return f"{0.0 if abs(value) < 0.05 else value:.1f}"


def figure(value: float) -> str:
    """Format a number with three significant digits, and without an exponent from 1e-4 to 1e7."""
    value = float(value)
    if value == 0 or not 1e-4 <= abs(value) < 1e7:
        return f"{value:.3g}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"


def interval_text(interval: Interval) -> str:
    """Format each value of a parameter with its unit and its range, such as "0.61 s (0.56 to 0.66)"."""
    values, lows, highs = (np.atleast_1d(x) for x in (interval.value, interval.low, interval.high))
    unit = UNITS.get(interval.unit, interval.unit)
    shown = [
        f"{figure(v)} {unit}".rstrip() + (f" ({figure(low)} to {figure(high)})" if low < high else "")
        for v, low, high in zip(values, lows, highs)
    ]
    return ", ".join(shown) or "none"


def comparison_summary(found: Comparison) -> list[str]:
    """Format what a person needs of a comparison: how much is unexplained, warnings, and where most of it is."""
    zones = found.independence.zones if found.independence else ()
    depends = any(zone.part.dependent and zone.share >= WEIGHT for zone in zones)
    shares = tuple((low, high, 100 * share) for low, high, share in found.lags if depends)
    lines = _compared(found)
    for name, where, rows, unit in (
        ("band", "Hz", found.bands, "dB"),
        ("time", "s", found.times, "dB"),
        ("lag", "ms behind the reference", shares, "% of the error"),
    ):
        if rows:
            low, high, value = max(rows, key=lambda row: row[2])
            lines.append(f"{f'worst {name}':<12}{low:g} to {high:g} {where}: {decibels(value)} {unit}")
    return lines[: LINES - 2]


def comparison_lines(found: Comparison) -> list[str]:
    """Format a comparison: the excess as a whole, by frequency, by time, by level and by lag, and whether the residual is noise."""
    lines = _compared(found)
    lines += _table("by frequency", "Hz", found.bands)
    lines += _table("by time", "s", coarser(found.times, len(found.bands)))
    lines += _table("by level of the robot's voice", "dBFS", found.levels)
    lines.append("by lag behind the reference")
    for low, high, share in found.lags:
        lines.append(f"  {low:5g} to {high:4g} ms  {100 * share:5.0f} %   {_bar(share)}".rstrip())
    return lines + independence_lines(found.independence)


def _compared(found: Comparison) -> list[str]:
    lines = [
        f"excess      {decibels(found.excess_db)} dB: unpredicted power over the noise floor of {decibels(found.noise_floor_db)} dBFS",
        f"lag         {found.offset_samples:+.2f} samples relative to the calibration, compensated",
    ]
    if found.drift_ppm:
        lines.append(f"clocks      the microphone's runs {apart(found.drift_ppm)}, compensated")
    if math.isfinite(found.silence_excess_db):
        silence = decibels(found.silence_excess_db)
        lines.append(f"silence     {silence} dB over the noise floor while the robot is silent")
    return lines + [f"WARNING     {text}" for text in found.warnings]


def apart(drift_ppm: float) -> str:
    """Format how much faster (above 0) or slower the microphone's clock runs than the reference's, such as "43.0 ppm slower"."""
    return f"{abs(drift_ppm):.1f} ppm {'faster' if drift_ppm > 0 else 'slower'}"


def first_sight_line(seen: Mapping[str, float]) -> str:
    """Say which families of effects explain how many dB of the loudest seconds, before any of them has a name."""
    parts = ", ".join(f"{family} {gain_db:.1f} dB" for family, gain_db in seen.items())
    return f"at first sight {parts or 'no family of effects explains more than chance does'}"


def summary_lines(found: Diagnosis, calibrated: bool = True, most: int = LINES - 2) -> list[str]:
    """Format what a person needs to go on: what is wrong, how sure that is, what is left, and as many warnings and hints as fit.

    most: lines; more where the findings alone need more. calibrated: as of diagnosis_lines().
    """
    lines = [_verdict(found, calibrated)]
    for rank, finding in enumerate(found.ranking, start=1):
        lines += _finding(rank, finding)[:2]
    lines += [_left(found), *_proof(found)]
    hints = [f"WARNING     {text}" for text in found.comparison.warnings] + _hints(found)
    hints += [f"advice      {line}" for line in found.advice]
    return [*lines, *hints[: max(most - len(lines), 0)]]


def diagnosis_lines(found: Diagnosis, calibrated: bool = True) -> list[str]:
    """Format all of a diagnosis: the verdict, the error budget, each finding with its evidence, the statistics, and the comparison.

    calibrated: False where the recording itself made the profile.
    """
    added = in_order(found.ranking)
    profile = "the profile as it is" if calibrated else "a stationary linear path"
    steps = [(profile, added[0].excess_before_db if added else found.comparison.excess_db)]
    steps += [(f"with {finding.effect}", finding.excess_after_db) for finding in added]
    top = max(1.0, *(db for _, db in steps))
    lines = [_verdict(found, calibrated), "budget      dB over the noise floor"]
    lines += [f"  {name:<27} {decibels(db):>6}  {_bar(db / top)}".rstrip() for name, db in steps]
    for rank, finding in enumerate(found.ranking, start=1):
        lines += _finding(rank, finding)
    lines += [_left(found), *_hints(found), *_proof(found), *precision_lines(found.precision)]
    if found.ranking:
        lines += independence_lines(found.independence, "with all findings")
    lines += [*candidate_lines(found.tried), *(f"advice      {line}" for line in found.advice)]
    return [*lines, f"where       the excess lies with {profile}:", *comparison_lines(found.comparison)]


def _verdict(found: Diagnosis, calibrated: bool) -> str:
    said = headline(found.verdict, [finding.name for finding in found.ranking], calibrated)
    return f"verdict     {found.verdict}: {said}"


def _left(found: Diagnosis) -> str:
    """Say what is left; where it is noise of the robot's own that no waveform predicts, that and no other figure."""
    whole = f" of {decibels(found.comparison.excess_db)}" if found.ranking else ""
    if found.irreducible_db:
        told = f"{decibels(found.irreducible_db)}{whole} dB over the fan: {IRREDUCIBLE}."
    else:
        told = f"{decibels(found.remaining_db)}{whole} dB over the noise floor."
    return f"left        {told} {sentence(found.evidence)}".rstrip()


def _hints(found: Diagnosis) -> list[str]:
    """Say which law was found."""
    own = "--write-effect MINE.py writes it as your own effect"
    return [f"law         {found.law.family}: {found.law.words}; {own}"] if found.law else []


def _proof(found: Diagnosis) -> list[str]:
    return [proof_line(found.proof, found.unproven)] if found.proof or found.unproven else []


def next_command(found: Diagnosis, names: Mapping[str, Any], written: str | None = None) -> str:
    """Give the one command that follows a diagnosis; written: the profile that it wrote, if any."""
    if found.ranking and written is None:
        return add_command([finding.effect for finding in in_order(found.ranking)], names)
    channels = f" --mic-channels {names['mic_channels']}" if names.get("mic_channels") else ""
    if found.verdict == "unexplained" and not names.get("report"):
        return f"edgefilter diagnose {files_given(names)}{channels} --report page.html"
    profile = written or names["profile"]
    if profile is None or found.verdict == "unexplained":
        return CALIBRATE
    files = files_given({**names, "profile": profile}).replace("--recording ", "--input ", 1)
    return f"edgefilter run {files}{channels} --output filtered.wav"


def add_command(effects: Sequence[str], names: Mapping[str, Any]) -> str:
    """Give the command that writes a profile with these effects, of all microphones; without a profile, the one that calibrates."""
    if names["profile"] is None:
        return CALIBRATE
    files = files_given(names)
    output = shlex.quote(str(Path(str(names["profile"])).with_suffix(f".{'.'.join(effects)}.npz")))
    if channels := names.get("mic_channels"):
        return f"edgefilter diagnose {files} --mic-channels {channels} --apply {output}"
    return f"edgefilter add {' '.join(effects)} {files} --output {output}"


def files_given(names: Mapping[str, Any]) -> str:
    """The options that name profile, recording, reference and own effects, as words of a command."""
    files = [(role, names[role]) for role in ("profile", "recording", "reference") if names[role]]
    files += [("effects", file) for file in names.get("effects") or ()]
    return " ".join(f"--{role} {shlex.quote(str(file))}" for role, file in files)


def coarser(times: Sequence[tuple[float, float, float]], rows: int) -> list[tuple[float, float, float]]:
    """Join neighbours (start_s, end_s, excess_db) until at most `rows` remain; a joined row has the mean of their powers."""
    step = math.ceil(len(times) / rows) if times else 1
    groups = [times[at : at + step] for at in range(0, len(times), step)]
    return [
        (group[0][0], group[-1][1], 10 * math.log10(np.mean([10 ** (db / 10) for _, _, db in group])))
        for group in groups
    ]


def _finding(rank: int, finding: Finding) -> list[str]:
    fall = f"{decibels(finding.excess_before_db)} to {decibels(finding.excess_after_db)} dB"
    return [
        f"{rank:>2}. {heading(finding)} ({finding.effect}): {fall}, {100 * finding.share:.0f} % of the excess;"
        f" {chance(finding)}",
        f"      {sentence(finding.evidence)}",
        f"      {finding.family}",
        *(f"      {name} = {told}" for name, told in known_parameters(finding).items()),
    ]


def heading(finding: Finding) -> str:
    """Title of a finding; a free law is named after the listed effect that brings a share of its gain with few parameters."""
    share = f", {100 * finding.like.share:.0f} % of {spoken(finding.effect)}" if finding.like else ""
    return title(finding.name) + share


def chance(finding: Finding) -> str:
    """Say how often a recording of a robot whose profile lacks nothing shows at least as much of this effect."""
    return f"{percent(finding.p_value)} of ordinary recordings show as much by chance"


def known_parameters(finding: Finding) -> dict[str, str]:
    """Format each parameter of a finding with its range; without one where that is as wide as what the parameter may be at all."""
    effect = find(finding.effect) if finding.effect in names() else None
    bounds = {p.name: (p.low, p.high) for p in effect.parameters} if effect else {}
    return {
        name: f"{interval_text(replace(one, low=one.value, high=one.value))}, which this recording hardly tells"
        if (one.low, one.high) == bounds.get(name)
        else interval_text(one)
        for name, one in finding.parameters.items()
    }


def _table(heading: str, unit: str, rows: Sequence[tuple[float, float, float]]) -> list[str]:
    top = max([1.0, *(db for _, _, db in rows)])
    return [heading] + [
        f"  {low:5.4g} to {high:4.4g} {unit:<4} {decibels(db):>6} dB  {_bar(db / top)}".rstrip()
        for low, high, db in rows
    ]


def _bar(part: float) -> str:
    return "#" * round(30 * min(max(part, 0.0), 1.0))  # lines stay within 80 columns


def independence_lines(found: Independence | None, what: str = "of the residual") -> list[str]:
    """Format which share of the correlations exceeds their bounds, and what follows from it; at most 80 columns."""
    if found is None:
        return []
    head = f"correlations {what}: lags beyond their 99 % bounds (noise: 1 %)"
    return [head] + [f"  {name:<17} {100 * part.outside:5.1f} %  {says}" for name, part, says in _verdicts(found)]


def candidate_lines(tried: Sequence[Candidate]) -> list[str]:
    """Format the table of all effects that the diagnosis has tried."""
    if not tried:
        return ["tried       nothing: the residual is no louder while the robot talks than while it is silent"]
    columns = "  {:>4} {:<20} {:>9} {:>10}  {}"
    table = [columns.format(*row) for row in (HEADS, *map(cells_of, tried))]
    return ["tried       all effects, by their gain on held-out samples", *table]


def precision_lines(found: Precision) -> list[str]:
    """Format each fitted number with its standard error, then the correlations between these errors."""
    if not found.numbers:
        return []
    width = max(len(known.label) for known in found.numbers)
    lines = ["known       number +/- standard error"]
    lines += [f"  {known.label:<{width}}  {error_text(known)}" for known in found.numbers]
    if found.correlations:
        lines.append("correlations of these errors")
        lines += [f"  {first}, {second}  {r:+.2f}" for first, second, r in found.correlations]
    return lines


def error_text(known: Known) -> str:
    """Format a number with its standard error, such as "-3.00 +/- 0.004 dB (0.1 %)".

    The text names the source of the error where this is not the prediction's derivatives.
    """
    unit = UNITS.get(known.unit, known.unit)
    if known.error is None:
        why = "at its bound" if known.source == "at its bound" else "no standard error: too few fits to tell"
        return f"{figure(known.value)} {unit}".rstrip() + f", {why}"
    share = known.error / abs(known.value) if known.value else 0.0
    part = f" ({100 * share:.2g} %)" if 0.0 < share < 1.0 else " (the error exceeds the number)" if share else ""
    by = ", from fits to thirds of the recording" if known.source == "thirds" else ""
    return f"{figure(known.value)} +/- {figure(known.error)} {unit}".rstrip() + part + by


def correlograms(found: Independence | None) -> dict[str, object] | None:
    """Give the curves that the HTML page draws of a residual's correlations, and the sentences below them."""
    if found is None:
        return None
    auto, *zones = [
        f"{name}, {100 * part.outside:.1f} % of lags exceed their bounds: {says}"
        for name, part, says in _verdicts(found)
    ]
    return {
        "auto": {**_drawn(found.autocorrelation), "says": [auto]},
        "cross": {**_drawn(found.cross_correlation), "says": zones},
    }


def _verdicts(found: Independence) -> list[tuple[str, Correlogram, str]]:
    """Name each correlogram and say what it shows: the autocorrelation, then the cross-correlation in each range of lags."""
    auto = found.autocorrelation
    at = auto.lags_ms[auto.largest]
    rows = [("autocorrelation", auto, f"not white, largest value at {at:.1f} ms" if auto.dependent else "white")]
    for zone in found.zones:
        says = f"{100 * zone.share:.0f} % of it: {zone.meaning}"
        if not zone.part.dependent:
            says = "independent"
        elif zone.share < WEIGHT:
            says = f"dependent, but below {100 * WEIGHT:.0f} % of it"
        rows.append((f"{zone.low_ms:g} to {zone.high_ms:g} ms", zone.part, says))
    return rows


def _drawn(part: Correlogram) -> dict[str, object]:
    curves = {"values": part.values, "expected": part.expected, "bounds": part.bounds}
    rounded = {name: np.round(curve.astype(float), 4).tolist() for name, curve in curves.items()}
    return {"from_ms": float(part.lags_ms[0]), "step_ms": float(part.lags_ms[1] - part.lags_ms[0]), **rounded}


def cells_of(row: Candidate) -> tuple[str, ...]:
    """Format the columns HEADS of a tried effect."""
    verdict = row.verdict + (f": {row.why}" if row.why else "")
    rank = "-" if row.rank is None else str(row.rank)
    gains = ("-" if db is None else f"{round(db, 2) + 0.0:.2f}" for db in (row.gain_db, row.beside_db))
    return (rank, row.effect, *gains, verdict)


def proof_line(proof: Proof | None, unproven: str) -> str:
    """Format how far the running filter lowers the robot without and with the effects (ERLE, dB), or say why that was not measured."""
    if proof is None:
        return f"proof       none: {unproven}"
    return (
        f"proof       running filter, {proof.seconds:.1f} s held out: ERLE {decibels(proof.erle_before_db)} dB before,"
        f" {decibels(proof.erle_after_db)} dB after"
    )
