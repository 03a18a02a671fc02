"""Which of several effects to name."""

from __future__ import annotations

from edgefilter.echo.effects.catalogue import find

NESTED = 0.85
"""A simpler effect that explains this share of what the best one does is preferred to it."""


def choose(gains: dict[str, float]) -> str | None:
    """The effect to name, from the falls in level that the admissible ones bring; None where there is none."""
    most = max(gains.values(), default=0.0)
    if not most > 0.0:
        return None
    enough = [name for name, gain in gains.items() if gain >= NESTED * most]
    return min(enough, key=lambda name: (find(name).complexity, -gains[name]))
