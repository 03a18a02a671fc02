"""Events for what source and sink have lost: each counter that has risen since the last look."""

from __future__ import annotations

from edgefilter.audio.protocols import Sink, Source
from edgefilter.types import SAMPLE_RATE, Event, EventKind

KINDS: dict[EventKind, tuple[str, ...]] = {
    "lost": ("_lost", "_filled", "_dropped", "_inserted", "_away", "missing", "dropped"),
    "overrun": ("_overruns",),
    "underrun": ("underruns",),
    "device_gone": ("_gone",),
    "device_back": ("_back",),
}
"""Endings of the counters' names, by the kind of event that each leads to."""
PERIOD = SAMPLE_RATE
"""Samples between two looks: a machine that cannot keep up loses something in every block."""


class Troubles:
    """Looks at the counters of source and sink; call it with the number of samples so far.

    >>> class Lossy:
    ...     def stats(self):
    ...         return {"microphone_lost": 160, "underruns": 0}
    >>> troubles = Troubles(Lossy(), Lossy())
    >>> [event.detail for event in troubles(16000, False)], troubles(16001, True)
    (['160 microphone lost, 160 microphone lost'], [])
    """

    def __init__(self, source: Source, sink: Sink) -> None:
        self._counted: tuple[Source | Sink, ...] = (source, sink)
        self._before: list[dict[str, int]] = [{}, {}]
        self._next = 0

    def __call__(self, sample: int, last: bool) -> list[Event]:
        """What was lost since the last look, at most one event of a kind; last: look even if that was just now."""
        if sample < self._next and not last:
            return []
        self._next = sample + PERIOD
        risen = []
        for number, each in enumerate(self._counted):
            now, before = dict(each.stats()), self._before[number]
            risen += [(name, count - before.get(name, 0)) for name, count in now.items()]
            self._before[number] = now
        happened = []
        for kind, endings in KINDS.items():
            words = [_words(name, count) for name, count in risen if count > 0 and name.endswith(endings)]
            if words:
                happened.append(Event(kind, sample, ", ".join(words)))
        return happened


def _words(name: str, count: int) -> str:
    """A counter that has risen, in words."""
    what, _, end = name.rpartition("_")
    if end == "gone":
        return f"{what}: silence stands in until it is back"
    return what if end == "back" else f"{count} {name.replace('_', ' ')}"
