"""The protocol that every engine follows: spectra in, the human's spectrum out, state passed and not hidden."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Protocol, TypeAlias

from edgefilter.stft import StftConfig
from edgefilter.types import Frame, Output

EngineState: TypeAlias = Any
"""Whatever an engine needs between frames; it is made by initial_state and never shared between streams."""

Front: TypeAlias = Literal["none", "paper", "full"]
"""What runs before the engine: nothing, the paper's per-utterance alignment, or tracking alignment and the linear stage."""


class Engine(Protocol):
    """Turns frames into output spectra.

    With lookahead L the answer to frame t is the output for frame t - L; the first L answers are for the digital silence
    before the recording, and the stream pushes L more frames of silence at the end.
    """

    name: ClassVar[str]
    front: ClassVar[Front]
    stft: StftConfig
    lookahead: int

    def initial_state(self) -> EngineState:
        """State before the first frame."""
        ...

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        """Answer one frame; neither frame nor state is written to, the returned state replaces the old one."""
        ...
