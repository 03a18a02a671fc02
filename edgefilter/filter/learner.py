"""Between the running filter and a learner: what is told of every hop, and the lesson that may come back."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from edgefilter.filter.echo_path import PathState
from edgefilter.types import EventKind, Samples


class FilteredHop(NamedTuple):
    """One hop of the running filter.

    mic, reference, innovation: (hop,) float32, the microphone, the aligned reference, and the microphone less the echo
    as predicted before the hop's own correction. located: whether the reference is known to lie where the microphone
    hears it. idle: whether nothing of the robot can be audible. past: (n,) the aligned reference up to and with this
    hop where its delay was switched in it, else None. delay: samples, of the direct sound; nan where unknown.
    """

    mic: Samples
    reference: Samples
    innovation: Samples
    located: bool
    idle: bool
    past: Samples | None
    delay: float


class Lesson(NamedTuple):
    """A path that predicts better than the one in use, to be taken over.

    kind: "learned", or "unlearned" where an earlier path comes back. detail: in words, with figures.
    """

    path: PathState
    kind: EventKind
    detail: str


class Learner(Protocol):
    """Follows the hops of one stream and now and then knows a better path."""

    @property
    def past(self) -> int:
        """Samples of the aligned reference that FilteredHop.past is to hold."""
        ...

    def start(self, path: PathState, hop: int) -> None:
        """A stream begins with that path, in steps of hop samples."""
        ...

    def observe(self, hop: FilteredHop) -> Lesson | None:
        """Take one hop; the lesson is adopted with the next one."""
        ...

    def stats(self) -> dict[str, object]:
        """What was learned so far, ready for JSON."""
        ...

    def close(self) -> None:
        """The stream is over."""
        ...
