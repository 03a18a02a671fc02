"""What the data path asks of a source and a sink, with answers for those that cannot lose anything."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, TypeVar

from edgefilter.types import Block, Samples

Itself = TypeVar("Itself")


class Source(Protocol):
    """Where blocks come from: a context manager whose iterator ends with the recording, or after stop().

    notes: what was done to the sound on its way in (converted, padded, dropped), one sentence each, for the user to
    read; complete when the iteration has ended. total: samples per channel at 16 kHz, None if unknown beforehand.
    live: blocks arrive in real time. microphones: channels of a block's mic, which is (n,) where it is one.
    """

    notes: list[str]
    total: int | None
    live: bool = False
    microphones: int = 1
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

    @property
    def lost(self) -> int:
        return self.stats()["lost"]


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
