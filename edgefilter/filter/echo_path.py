"""The echo path as the filter models it: the effects ahead of the loudspeaker, and the adaptive filter behind them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edgefilter.echo.measurement import Values
from edgefilter.echo.source_chain import SourceChain, VoiceChain
from edgefilter.filter.canceller import LEARNED, WARM, Canceller, CancellerOutput, CancellerState
from edgefilter.profile.data import Profile
from edgefilter.types import Samples

TAPS = (2048, 8192)
"""Least and most taps of the linear stage, 128 to 512 ms; between them the profile's impulse response decides."""

Effects = tuple[tuple[str, Values], ...]
"""(name, values) of effects."""


@dataclass(frozen=True, slots=True)
class PathState:
    """An EchoPath at one moment, without the sound that is under way in it: what can be handed to another one."""

    effects: Effects
    canceller: CancellerState


class EchoPath:
    """Predicts and subtracts the echo: the effects ahead of the loudspeaker, the canceller, the microphone behind it.

    effects: of the whole model; those that are filters on the path are left to the canceller's impulse response. source:
    what they do ahead of the loudspeaker.
    """

    def __init__(self, canceller: Canceller, effects: Effects = ()) -> None:
        self.effects = effects
        self.source = SourceChain(effects)
        self.canceller = canceller
        canceller.behind = _behind(effects, canceller.microphones)

    @property
    def history(self) -> int:
        """Reference samples that `past` is to hold at least."""
        return max(self.canceller.history, self.source.memory)

    def step(self, mic: Samples, reference: Samples, located: bool, past: Samples | None = None) -> CancellerOutput:
        """One hop (hop,) of the microphone, of an array (microphones, hop), and of the aligned reference (hop,).

        past: (n,) the aligned reference up to and with this hop where its delay was switched in it, else None.
        """
        before = None if past is None else self.source.restart(past[: -reference.size])
        driven = self.source(reference)
        if before is not None:
            self.canceller.rewrite_reference(np.concatenate((before, driven)))
        return self.canceller.step(mic, driven, located)

    def state(self) -> PathState:
        """Copies of what it knows."""
        return PathState(self.effects, self.canceller.state())

    @classmethod
    def resumed(cls, state: PathState, past: Samples, hop: int) -> EchoPath:
        """The path of that state. past: (n,) the aligned reference up to and with the hop that is stepped next."""
        path = cls(Canceller.resumed(state.canceller, hop), state.effects)
        before = path.source.restart(past[:-hop])
        path.canceller.rewrite_reference(np.concatenate((before, np.zeros(hop, np.float32))))
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
