"""All effects that a search has tried, the best first, why each was named or not, and which explanations remain."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.ordinary import percent
from edgefilter.diagnosis.result import Candidate, Fate
from edgefilter.diagnosis.trials import Found, Tried
from edgefilter.echo.effects.catalogue import find

RIVAL = 0.7
"""Part of the fall in level by what is named, from which on another explanation remains: twice as far behind as a
simpler effect may be and is named all the same (Criteria.nearly). Not tuned."""
MOST = 4
"""Explanations that remain at most, the best ones: each costs a fit for each sound that is tried."""


def candidates(found: Found, named: Collection[str]) -> tuple[Candidate, ...]:
    """The table of a search, and of the changes of the fan that it has seen; named: the effects that the diagnosis gives.

    An effect that was tried beside others only is ranked by its gain there.
    """
    tried = {entry.name: entry for entry in found.tried}
    seen = {step.name: Tried(step.name, None if place else step, step) for place, step in enumerate(found.steps)}
    rows = [_row(entry, found, named) for entry in {**seen, **tried}.values()]
    gains = {row.effect: row.beside_db if row.gain_db is None else row.gain_db for row in rows}
    ranked = sorted((row for row in rows if gains[row.effect] is not None), key=lambda row: -(gains[row.effect] or 0.0))
    rest = sorted((row for row in rows if gains[row.effect] is None), key=lambda row: row.effect)
    return (*(replace(row, rank=place) for place, row in enumerate(ranked, start=1)), *rest)


def _row(entry: Tried, found: Found, named: Collection[str]) -> Candidate:
    verdict, why = _fate(entry, found, named)
    beside = next((step for step in found.steps if step.name == entry.name), entry.beside)
    alone_db, beside_db = (trial.gain_db if trial else None for trial in (entry.alone, beside))
    return Candidate(entry.name, verdict, why, alone_db, beside_db)


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


def asks(tried: Sequence[Candidate]) -> tuple[str, ...]:
    """One line where several explanations remain: `edgefilter probe` can find out which of them is true; none otherwise."""
    left = [" with ".join(effects) for effects in remaining(tried)]
    told = f"{', '.join(left[:-1])} or {left[-1]}: edgefilter probe plays what tells them apart" if left[1:] else ""
    return (told,) if told else ()


def remaining(tried: Sequence[Candidate]) -> tuple[tuple[str, ...], ...]:
    """The effects of each explanation that remains: all that are named, then each that alone explains nearly as much.

    Events are left out, since no other recording has them.
    """
    named = [row for row in tried if row.verdict == "named"]
    rivals = [row for row in tried if row.verdict in ("explained by another", "explains too little")]
    gains = [row.gain_db or 0.0 for row in rivals]
    most = sum(max(row.beside_db or 0.0, row.gain_db or 0.0) for row in named) if named else max(gains, default=0.0)
    near = sorted((r for r in rivals if (r.gain_db or 0.0) >= RIVAL * most > 0.0), key=lambda r: -(r.gain_db or 0.0))
    sets = [[row.effect for row in rows if not find(row.effect).event] for rows in (named, *([row] for row in near))]
    return tuple(dict.fromkeys(tuple(effects) for effects in sets if effects))[:MOST]
