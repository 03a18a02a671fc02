"""What the data path asks of a source and a sink, with answers for those that cannot lose anything, and events for what is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Protocol, TypeVar

from edgefilter.types import SAMPLE_RATE, Block, Event, EventKind, Samples

Itself = TypeVar("Itself")
KINDS: dict[EventKind, tuple[str, ...]] = {
    "lost": ("_lost", "_filled", "_dropped", "_inserted", "_away", "missing", "dropped"),
    "overrun": ("_overruns",),
    "underrun": ("underruns",),
    "device_gone": ("_gone",),
    "device_back": ("_back",),
}
"""Endings of the counters' names, by the kind of event that each leads to."""


class Source(Protocol):
    """Where blocks come from: a context manager whose iterator ends with the recording, or after stop().

    notes: what was done to the sound on its way in (converted, padded, dropped), one sentence each, for the user to
    read; complete when the iteration has ended. total: samples per channel at 16 kHz, None if unknown beforehand.
    live: blocks arrive in real time. microphones: channels of a block's mic, which is (n,) where it is one.
    monitored: the sound server's output whose monitor is the reference, '' where it is something else.
    """

    notes: list[str]
    total: int | None = None
    live: bool = False
    microphones: int = 1
    monitored: str = ""
    _stopped: bool = False

    def __enter__(self: Itself) -> Itself:
        return self

    def __exit__(self, *exc: object) -> None:
        return None

    def __iter__(self) -> Iterator[Block]: ...

    def stop(self) -> None:
        """End the iteration soon, with everything received so far delivered; may be called from a signal handler."""
        self._stopped = True

    def stats(self) -> dict[str, int]:
        """Counters by name; lost: samples that were filled with silence or dropped so far."""
        return {"lost": 0}


class Sink(Protocol):
    """Where finished samples go: a context manager that leaves a valid result behind however it is left.

    notes: one sentence each about what happened to the samples; complete after the context has ended.
    finished: nobody takes samples any more (the program behind a pipe has ended), so there is no point in going on.
    written, clipped: samples so far, and those of them beyond full scale.
    """

    notes: list[str]
    finished: bool = False
    written: int = 0
    clipped: int = 0

    def __enter__(self: Itself) -> Itself:
        return self

    def __exit__(self, *exc: object) -> None:
        return None

    def write(self, samples: Samples) -> None:
        """Take samples (n,) float32, full scale +-1."""

    def stats(self) -> dict[str, int]:
        """Counters by name."""
        return {"written": self.written, "clipped": self.clipped}


class Troubles:
    """Looks at the counters of source and sink, once a second at most; call it with the number of samples so far.

    >>> class Lossy:
    ...     def stats(self):
    ...         return {"microphone_lost": 160, "underruns": 0}
    >>> troubles = Troubles(Lossy(), Lossy())
    >>> [event.detail for event in troubles(16000, False)], troubles(16001, True)
    (['160 microphone lost, 160 microphone lost'], [])
    """

    def __init__(self, source: Source, sink: Sink) -> None:
        self._counted = (source, sink)
        self._before: list[Counter[str]] = [Counter(), Counter()]
        self._next = 0

    def __call__(self, sample: int, last: bool) -> list[Event]:
        """What was lost since the last look, at most one event of a kind; last: look even if that was just now."""
        if sample < self._next and not last:
            return []
        self._next = sample + SAMPLE_RATE
        now = [Counter(each.stats()) for each in self._counted]
        risen = [item for new, old in zip(now, self._before) for item in (new - old).items()]
        self._before = now
        happened = []
        for kind, endings in KINDS.items():
            words = [_words(name, count) for name, count in risen if name.endswith(endings)]
            if words:
                happened.append(Event(kind, sample, ", ".join(words)))
        return happened


def _words(name: str, count: int) -> str:
    """A counter that has risen, in words."""
    what, _, end = name.rpartition("_")
    if end == "gone":
        return f"{what}: silence stands in until it is back"
    return what if end == "back" else f"{count} {name.replace('_', ' ')}"
