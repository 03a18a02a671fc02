"""Which explanations a diagnosis leaves, and what to record to tell two effects apart that explain about as much."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.result import Candidate
from edgefilter.echo.effect import Effect, Experiment
from edgefilter.echo.effects.catalogue import find

RIVAL = 0.7
"""Part of the fall in level by what is named, from which on another explanation remains: twice as far behind as a
simpler effect may be and is named all the same (Criteria.nearly). Not tuned."""
MOST = 4
"""Explanations that remain at most, the best ones: each costs a fit for each sound that is tried."""
RULES: tuple[tuple[Experiment, str], ...] = (
    ("levels", "play the same sentences at two volumes, 6 dB apart: only {shows} grows or shrinks by another amount"),
    ("minute", "record a minute and more: only {shows} goes on growing"),
    ("tail", "record two seconds of silence after the last word: only {shows} goes on sounding"),
    ("place", "record once more a metre away: only {shows} is another there"),
    ("sweep", "calibrate again, by a sweep: only {shows} differs from one frequency to the next"),
    ("tone", "play a steady tone of 300 Hz: only {shows} adds harmonics"),
)
"""For what the effects say of themselves (Effect.shown_by), the surest first."""


def advice(tried: Sequence[Candidate]) -> tuple[str, ...]:
    """A line for each named effect and each other effect where both, each alone, explain about as much.

    A flexible effect takes up what a simple one does and says nothing against it, so such a pair is no question; nor is
    one that does not reach its bar.
    """
    rivals = [c for c in tried if c.gain_db is not None and c.verdict in ("named", "explained by another")]
    lines = []
    for first, second in combinations(rivals, 2):
        if first.verdict == second.verdict:
            continue
        gains = first.gain_db or 0.0, second.gain_db or 0.0
        one, other = find(first.effect), find(second.effect)
        if min(gains) >= Criteria.nearly * max(gains) and one.flexible == other.flexible:
            told = f"{first.effect} ({gains[0]:.2f} dB) or {second.effect} ({gains[1]:.2f} dB)"
            lines.append(f"{told}: {_difference(one, other)}")
    return tuple(lines)


def asks(tried: Sequence[Candidate]) -> tuple[str, ...]:
    """A line where several explanations remain: the robot can ask which it is."""
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


def _difference(first: Effect, second: Effect) -> str:
    """The experiment in which just one of two effects shows itself."""
    for shown, other in permutations((first, second)):
        if shown.scales_fan and not other.scales_fan:
            return f"record ten seconds of silence before the robot talks: only {shown.name} changes the fan as well"
        if shown.event and not other.event:
            return f"record the same sentences again: only {shown.name} does not come again"
    for kind, rule in RULES:
        shows = [effect.name for effect in (first, second) if kind in effect.shown_by]
        if len(shows) == 1:
            return rule.format(shows=shows[0])
    for shown, other in permutations((first, second)):
        if shown.stage == "microphone" and other.stage != "microphone":
            return f"let a telephone play beside the robot, as loud as it: only {shown.name} happens to that as well"
        if shown.adds_noise and not other.adds_noise:
            return f"play one sentence three times: only {shown.name} is another each time"
    return "nothing else shows them apart than a longer recording"
