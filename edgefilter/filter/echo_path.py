"""The echo path as the filter models it: the effects ahead of the loudspeaker, and the adaptive filter behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edgefilter.echo.measurement import Values
from edgefilter.echo.source_chain import SourceChain, VoiceChain
from edgefilter.filter.adaptation import LEARNED, WARM
from edgefilter.filter.canceller import Canceller, CancellerOutput, CancellerState
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

    effects: of the whole model; those that are filters on the path are left to the canceller's impulse response.
    source: what they do ahead of the loudspeaker.
    """

    def __init__(self, canceller: Canceller, effects: Effects = ()) -> None:
        self.effects = effects
        self.source = SourceChain(effects)
        self.canceller = canceller
        canceller.behind = VoiceChain(effects) or None

    @property
    def history(self) -> int:
        """Reference samples that `past` is to hold at least."""
        return max(self.canceller.history, self.source.memory)

    def step(self, mic: Samples, reference: Samples, located: bool, past: Samples | None = None) -> CancellerOutput:
        """One hop (hop,) of the microphone and of the aligned reference.

        past: (n,) the aligned reference up to and with this hop where its delay was switched in it, else None.
        """
        before = None if past is None else self.source.restart(past[: -mic.size])
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


def starting_path(profile: Profile | None, hop: int) -> EchoPath:
    """What a filter with that profile, or with none, begins with."""
    if profile is None:
        return EchoPath(Canceller(hop))
    response = profile.echo.running_response()
    adaptation = LEARNED if profile.learned else WARM
    return EchoPath(Canceller(hop, int(np.clip(response.size, *TAPS)), response, adaptation), profile.echo.effects)
