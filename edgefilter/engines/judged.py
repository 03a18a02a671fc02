"""An engine's spectrum with the network's probability of speech: barge-in for engines that give none."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from edgefilter import engines
from edgefilter.engines.base import ClipEngine, Engine, EngineState, FrontEndKind
from edgefilter.errors import UsageError
from edgefilter.types import Frame, Output

if TYPE_CHECKING:
    from edgefilter.profile.data import Profile

JUDGE = "crnn"
"""The engine whose network says for others whether a human speaks."""


class Judged:
    """Runs both on every frame; the state is both engines'.

    engine: whose spectrum is the answer, and whose name this has. judge: whose probability of speech is taken. model:
    the judge's. Raises UsageError where the two do not take the same frames.
    """

    def __init__(self, engine: Engine, judge: Engine) -> None:
        for what in ("stft", "front", "lookahead"):
            own, other = getattr(engine, what), getattr(judge, what)
            if own != other:
                raise UsageError(
                    f"engine {judge.name} cannot judge speech for {engine.name}: its {what} is {other}, expected {own}"
                )
        self.name = engine.name
        self.stft = engine.stft
        self.front: FrontEndKind = engine.front
        self.lookahead = engine.lookahead
        self.model = getattr(judge, "model", None)
        self._engine, self._judge = engine, judge

    def initial_state(self) -> EngineState:
        return self._engine.initial_state(), self._judge.initial_state()

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        output, own = self._engine.step(frame, state[0])
        judged, other = self._judge.step(frame, state[1])
        return Output(output.spectrum, judged.speech_probability), (own, other)


def with_network_as_judge(engine: Engine | ClipEngine, profile: Profile | None = None) -> Engine | ClipEngine:
    """The engine with the judgement of crnn's network; crnn as it is.

    profile: the robot. Raises UsageError for an engine that has no linear stage, ModelError where the network cannot be loaded.
    """
    if engine.name == JUDGE:
        return engine
    return cast(Engine, Judged(cast(Engine, engine), cast(Engine, engines.create(JUDGE, profile))))


def judges_speech(engine: Engine | ClipEngine) -> bool:
    """Whether the engine says how probable it is that a human speaks."""
    return engine.name == JUDGE or isinstance(engine, Judged)
