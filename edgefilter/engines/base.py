"""The protocol of every engine: spectra in, the human's spectrum out, state passed in and out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Protocol, TypeAlias

from edgefilter.dsp.stft import StftConfig
from edgefilter.types import Frame, Output, Spectrum

EngineState: TypeAlias = Any
"""Whatever an engine needs between frames; it is made by initial_state and never shared between streams."""
FrontEndKind: TypeAlias = Literal["none", "paper", "full"]
"""What runs before the engine: nothing, the paper's alignment of each utterance, or tracking alignment and linear stage."""


class Engine(Protocol):
    """Turns frames into output spectra.

    With lookahead L the answer to frame t is the output for frame t - L; the first L answers are for the digital
    silence before the recording, and the stream pushes L more frames of silence at the end.
    """

    name: ClassVar[str]
    stft: StftConfig
    lookahead: int

    @property
    def front(self) -> FrontEndKind:
        """What the stream has to run before it."""
        ...

    def initial_state(self) -> EngineState:
        """State before the first frame."""
        ...

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        """Answer one frame; neither frame nor state is written to, the returned state replaces the old one."""
        ...


class ClipEngine(Protocol):
    """Needs the whole recording before it can answer any of it; the stream then gives everything at flush."""

    name: ClassVar[str]
    front: ClassVar[FrontEndKind]
    stft: StftConfig
    lookahead: None
    longest: int
    """The most frames of the STFT that the engine takes; the stream refuses a longer recording."""

    def answer(self, frames: Sequence[Frame]) -> Sequence[Spectrum]:
        """The human's spectrum (bins,) for each frame of the recording, of which there is at least one."""
        ...
