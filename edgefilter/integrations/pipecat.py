"""Pipecat: one filter at both ends of a transport, and its judgement of who speaks.

    ears = EgoFilters(EgoFilter("robot.npz", budget_ms=8))
    params = LocalAudioTransportParams(audio_in_enabled=True, audio_out_enabled=True, **ears.params)

Needs `pip install edgefilter[pipecat]`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from pipecat.audio.filters.base_audio_filter import BaseAudioFilter
from pipecat.audio.vad.vad_analyzer import VADAnalyzer, VADParams
from pipecat.frames.frames import FilterControlFrame, FilterEnableFrame

from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex, as_pcm16, from_pcm16
from edgefilter.types import SAMPLE_RATE, Event

PATIENCE_S = 0.12
"""A transport hands over 40 ms when it has room for them, and a resampler holds 40 ms back: speech that is later than
both together did not come in time for the loudspeaker either."""
JUDGED = 256
"""Samples at 16 kHz between two looks at whether the human speaks: a hop of the filter."""


class EgoFilters:
    """The robot's own voice out of a Pipecat transport's microphone.

    Pipecat asks a filter at each end by the same method, so this object has two faces, `params`, over one filter: the
    one at the loudspeaker hears exactly what is written to it and changes nothing, the one at the microphone filters.

    Parameters
    ----------
    ego : EgoFilter, optional
        As of `edgefilter.integrations.duplex.Duplex`.
    in_channels, out_channels : int
        The transport's `audio_in_channels` and `audio_out_channels`.
    on_event : callable, optional
        Called with each `edgefilter.Event`, in a thread of the event loop's executor.

    Attributes
    ----------
    params : dict
        `audio_in_filter` and `audio_out_filter`, for `TransportParams`.
    duplex : Duplex
        What both faces share: `duplex.stats()`, `duplex.ego`.
    """

    def __init__(
        self,
        ego: EgoFilter | None = None,
        in_channels: int = 1,
        out_channels: int = 1,
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        self.duplex = Duplex(ego, PATIENCE_S, on_event)
        self.params: dict[str, BaseAudioFilter] = {
            "audio_in_filter": _Microphone(self.duplex, in_channels),
            "audio_out_filter": _Loudspeaker(self.duplex, out_channels),
        }

    def vad(self, params: VADParams | None = None) -> VADAnalyzer:
        """The filter's own judgement of who speaks, as the `vad_analyzer` of Pipecat's user turns.

        With an engine that judges it (`crnn`) in place of Silero, which takes what is left of the robot for somebody.
        """
        return _HumanVAD(self.duplex.ego, params)


class _Face(BaseAudioFilter):
    """What both ends have in common: a rate, and that a FilterEnableFrame at either of them concerns both."""

    def __init__(self, duplex: Duplex, channels: int) -> None:
        self._duplex = duplex
        self._channels = channels
        self._rate = SAMPLE_RATE

    async def start(self, sample_rate: int) -> None:
        self._rate = sample_rate

    async def stop(self) -> None:
        pass

    async def process_frame(self, frame: FilterControlFrame) -> None:
        if isinstance(frame, FilterEnableFrame):
            self._duplex.enabled = frame.enable


class _Microphone(_Face):
    async def filter(self, audio: bytes) -> bytes:
        """Filter in a thread: a hop takes some milliseconds, which the event loop has not got."""
        human = await asyncio.to_thread(self._duplex.hear, from_pcm16(audio, self._channels), self._rate)
        return as_pcm16(human, self._channels)

    async def stop(self) -> None:
        await asyncio.to_thread(self._duplex.close)


class _Loudspeaker(_Face):
    async def filter(self, audio: bytes) -> bytes:
        self._duplex.play(from_pcm16(audio, self._channels), self._rate)
        return audio


class _HumanVAD(VADAnalyzer):
    """Whether the filter says that the human speaks; how sure is sure enough, its BargeInSettings say."""

    def __init__(self, ego: EgoFilter, params: VADParams | None) -> None:
        super().__init__(params=params or VADParams(confidence=0.5, start_secs=0.0, min_volume=0.0))
        self._ego = ego

    def num_frames_required(self) -> int:
        return JUDGED * self.sample_rate // SAMPLE_RATE

    def voice_confidence(self, buffer: bytes) -> float:
        return float(self._ego.human_speaks)
