"""The echo path as the filter models it, from the effects ahead of the loudspeaker on, and what a learner hears and says of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from edgefilter.echo.measurement import Values
from edgefilter.echo.running import SourceChain, VoiceChain
from edgefilter.filter.canceller import LEARNED, WARM, Canceller, CancellerOutput, CancellerState
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, EventKind, Samples

TAPS = (2048, 8192)
"""Least and most taps of the linear stage, 128 to 512 ms; between them the profile's impulse response decides."""
PAST = SAMPLE_RATE
"""Samples of the aligned reference, longer than any path, that a learner is told after a switch of the delay."""

Effects = tuple[tuple[str, Values], ...]
"""(name, values) of effects."""


@dataclass(frozen=True, slots=True)
class PathState:
    """An EchoPath at one moment, without the sound that is under way in it: what can be handed to another one."""

    effects: Effects
    canceller: CancellerState


class EchoPath:
    """Predicts and subtracts the echo: the effects ahead of the loudspeaker, the canceller, the microphone behind it.

    effects: of the whole model; filters on the path are left to the canceller. source: what they do ahead of the loudspeaker.
    """

    def __init__(self, canceller: Canceller, effects: Effects = ()) -> None:
        self.effects = effects
        self.source = SourceChain(effects)
        self.canceller = canceller
        canceller.behind = _behind(effects, canceller.microphones)

    @property
    def history(self) -> int:
        """Reference samples that `past` is to hold at least."""
        return max(self.canceller.history, self.source.memory) + self.canceller.hop

    def step(self, mic: Samples, reference: Samples, located: bool, past: Samples | None = None) -> CancellerOutput:
        """One hop (hop,) of the microphone, of an array (microphones, hop), and of the aligned reference (hop,).

        past: (n,) the aligned reference up to and with this hop where its delay was switched in it, else None.
        """
        if past is not None:
            self.canceller.rewrite_reference(self.source.restart(past[: -reference.size]))
        return self.canceller.step(mic, self.source(reference), located)

    def state(self) -> PathState:
        """Copies of what it knows."""
        return PathState(self.effects, self.canceller.state())

    @classmethod
    def resumed(cls, state: PathState, past: Samples, hop: int) -> EchoPath:
        """The path of that state. past: (n,) the aligned reference up to and with the hop that is stepped next."""
        path = cls(Canceller.resumed(state.canceller, hop), state.effects)
        path.canceller.rewrite_reference(path.source.restart(past[:-hop]))
        return path


def starting_path(profile: Profile | None, hop: int, microphones: int | None = None) -> EchoPath:
    """What a filter with that profile, or with none, begins with; microphones: of an array, None for a single one."""
    if profile is None:
        return EchoPath(Canceller(hop, microphones=microphones))
    response = profile.running_responses() if microphones else profile.echo.running_response()
    adaptation = LEARNED if profile.learned else WARM
    taps = int(np.clip(response.shape[-1], *TAPS))
    return EchoPath(Canceller(hop, taps, response, adaptation, microphones=microphones), profile.echo.effects)


def _behind(effects: Effects, microphones: int | None) -> Callable[[Samples, Samples], Samples] | None:
    """What the microphone, or each one of an array, does behind the path; None where it does nothing."""
    if microphones is None:
        return VoiceChain(effects) or None
    chains = [VoiceChain(effects) for _ in range(microphones)]
    if not chains[0]:
        return None
    return lambda echo, mic: np.stack([chain(*own) for chain, *own in zip(chains, echo, mic)])


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


class PathUpdate(NamedTuple):
    """An echo path to use from now on, since it predicts the echo better. kind: "learned", or "unlearned" where an earlier one comes back."""

    path: PathState
    kind: EventKind
    detail: str


class Learner(Protocol):
    """Follows the hops of one stream and now and then knows a better path."""

    def start(self, path: PathState, hop: int) -> None:
        """A stream begins with that path, in steps of hop samples."""

    def observe(self, hop: FilteredHop) -> PathUpdate | None:
        """Take one hop; the update is adopted with the next one."""

    def stats(self) -> dict[str, object]:
        """What was learned so far, ready for JSON."""

    def close(self) -> None:
        """The stream is over."""
