"""All effects that a search has tried, the best first: gain, size, rank and why each was named or not."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import percent
from edgefilter.diagnosis.result import Candidate, Fate
from edgefilter.diagnosis.straightened import HOP, STEP, bands
from edgefilter.diagnosis.trials import Found, Tried
from edgefilter.echo.effect import neutral
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values


def candidates(found: Found, named: Collection[str]) -> tuple[Candidate, ...]:
    """The table of a search, and of the changes of the fan that it has seen; named: the effects that the diagnosis gives.

    The information criterion (Schwarz 1978) is that of Score.level_db's likelihood: ln(N) for each number of the fit,
    less 2 N times the fall of the level, N the samples held out: the penalty comes on top of that. An effect that was
    tried beside others only is ranked by its gain there.
    """
    held = float(found.recording.starts.size * STEP) * bands().freedom.sum() / (HOP - 1)
    tried = {entry.name: entry for entry in found.tried}
    seen = {step.name: Tried(step.name, None if place else step, step) for place, step in enumerate(found.steps)}
    rows = [_row(entry, found, named, held) for entry in {**seen, **tried}.values()]
    ranked = sorted((row for row in rows if row.delta_bic is not None), key=lambda row: row.delta_bic or 0.0)
    rest = sorted((row for row in rows if row.delta_bic is None), key=lambda row: row.effect)
    return (*(replace(row, rank=place) for place, row in enumerate(ranked, start=1)), *rest)


def size_of(name: str, values: Values) -> float:
    """How many numbers carry an effect: one for each that is not neutral, and of a filter as many as hold its energy.

    The latter is the exponential of the entropy of how the energy is spread: a tail that dies away is fewer numbers
    than it has taps.
    """
    plain, given = neutral(find(name)), {p.name for p in find(name).parameters if p.given}
    count = 0.0
    for key, value in values.items():
        change = np.ravel(np.asarray(value, float) - plain[key]) ** 2
        if key in given or not change.any():
            continue
        part = change[change > 0.0] / change.sum()
        count += float(np.exp(-np.sum(part * np.log(part)))) if part.size > 1 else 1.0
    return count


def _row(entry: Tried, found: Found, named: Collection[str], held: float) -> Candidate:
    verdict, why = _fate(entry, found, named)
    beside = next((step for step in found.steps if step.name == entry.name), entry.beside)
    alone_db, beside_db = (trial.gain_db if trial else None for trial in (entry.alone, beside))
    row = Candidate(entry.name, verdict, why, alone_db, beside_db)
    trial = entry.alone or beside
    if not trial:
        return row
    numbers = size_of(entry.name, trial.values)
    bic = numbers * float(np.log(max(held, 2.0))) - held * np.log(10.0) / 5.0 * trial.gain_db
    return replace(row, numbers=numbers, delta_bic=float(bic))


def _fate(entry: Tried, found: Found, named: Collection[str]) -> tuple[Fate, str]:
    """What became of an effect, and why."""
    if entry.name in named:
        return "named", ""
    if any(step.name == entry.name for step in found.steps):
        return "explains too little", "and so does all that was found together"
    if entry.failed:
        return "not fitted", entry.failed
    if entry.spared:
        return "not fitted", "what is left is too little for it to be named"
    if entry.alone is None and entry.beside is None:
        return "below its bar", "its fit finds nothing"
    if entry.alone and entry.alone.p_value > Criteria.false_rate:
        return "below its bar", f"{percent(entry.alone.p_value)} of ordinary recordings show as much of some effect"
    if not named:
        return "explains too little", "for it to be what happened"
    beside = entry.beside
    added = (
        f"beside what is named it adds {beside.gain_db:.2f} dB" if beside else "beside what is named it adds nothing"
    )
    return "explained by another", added
