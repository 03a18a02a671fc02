"""The engines without a mask: what the canceller could not predict, and the microphone as it is."""

from __future__ import annotations

from typing import ClassVar

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.base import EngineState, FrontEndKind
from edgefilter.types import Frame, Output


class Linear:
    """Returns the linear stage's error: nothing is masked, so the human is not distorted and noise stays."""

    name: ClassVar[str] = "linear"
    front: ClassVar[FrontEndKind] = "full"

    def __init__(self, stft: StftConfig = StftConfig()) -> None:
        self.stft = stft
        self.lookahead = 0

    def initial_state(self) -> EngineState:
        return None

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        return Output(frame.error), state


class Bypass(Linear):
    """Returns the microphone: it tests the stream, and is the unfiltered row of every table."""

    name: ClassVar[str] = "bypass"
    front: ClassVar[FrontEndKind] = "none"

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        return Output(frame.mic), state
