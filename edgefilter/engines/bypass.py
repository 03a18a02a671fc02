"""The engine that changes nothing: it tests the stream, and is the unfiltered row of every table."""

from __future__ import annotations

from typing import ClassVar

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.base import EngineState, FrontEndKind
from edgefilter.types import Frame, Output


class Bypass:
    """Returns the microphone."""

    name: ClassVar[str] = "bypass"
    front: ClassVar[FrontEndKind] = "none"

    def __init__(self, stft: StftConfig = StftConfig()) -> None:
        self.stft = stft
        self.lookahead = 0

    def initial_state(self) -> EngineState:
        return None

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        return Output(frame.mic), state
