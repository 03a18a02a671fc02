"""Pipecat: one filter for a transport's microphone and loudspeaker, and its voice activity detection.

    ears = EgoFilters(EgoFilter("robot.npz"))
    params = LocalAudioTransportParams(audio_in_enabled=True, audio_out_enabled=True, **ears.params)

Needs `pip install '.[pipecat]'` in a checkout.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from pipecat.audio.filters.base_audio_filter import BaseAudioFilter
from pipecat.audio.vad.vad_analyzer import VADAnalyzer, VADParams
from pipecat.frames.frames import FilterControlFrame, FilterEnableFrame

from edgefilter.errors import UsageError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex
from edgefilter.types import SAMPLE_RATE, Event


class EgoFilters:
    """Removes the robot's voice from a Pipecat transport's microphone.

    Two Pipecat filters share one EgoFilter: the one of the loudspeaker takes what is written to it as the reference and
    changes nothing, the one of the microphone filters.

    Parameters
    ----------
    ego : EgoFilter, optional
        As of `edgefilter.integrations.duplex.Duplex`.
    in_channels, out_channels : int
        Channels of the transport's microphone and loudspeaker. Pipecat tells a filter neither, so `params` tells the
        transport: one that is given another number as well is refused by Python.
    on_event : callable, optional
        Called with each `edgefilter.Event`, in a thread of the event loop's executor.

    Attributes
    ----------
    params : dict
        For `TransportParams(**params)`: `audio_in_filter`, `audio_in_channels`, `audio_out_filter`,
        `audio_out_channels`.
    duplex : Duplex
        Shared by both filters: `duplex.stats()`, `duplex.ego`.
    """

    def __init__(
        self,
        ego: EgoFilter | None = None,
        in_channels: int = 1,
        out_channels: int = 1,
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        self.duplex = Duplex(ego, on_event=on_event)
        self.params: dict[str, Any] = {
            "audio_in_filter": _Microphone(self.duplex, in_channels),
            "audio_in_channels": in_channels,
            "audio_out_filter": _Loudspeaker(self.duplex, out_channels),
            "audio_out_channels": out_channels,
        }

    def vad(self, params: VADParams | None = None) -> VADAnalyzer:
        """Return the filter's own voice activity detection, as the `vad_analyzer` of Pipecat's user turns.

        It replaces Silero, which takes what is left of the robot's voice for a human.

        Raises
        ------
        UsageError
            Where the filter's engine, or a cheaper one that may take over, judges no speech: the human would not be
            noticed.
        """
        ego = self.duplex.ego
        if not ego.judges_speech:
            raise UsageError(
                f"vad() got a filter whose engines ({', '.join(ego.stats()['engines'])}) do not all judge speech, so"
                " that the human would not be noticed: leave out budget_ms, or give EgoFilter"
                " barge_in=BargeInSettings(judge='network')"
            )
        return _HumanVAD(ego, params)


class _Filter(BaseAudioFilter):
    """The common part of both filters: the rate; a FilterEnableFrame for either of them concerns both."""

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


class _Microphone(_Filter):
    async def filter(self, audio: bytes) -> bytes:
        """Filter in a thread: a hop takes some milliseconds, too many for the event loop."""
        return await asyncio.to_thread(self._duplex.hear_pcm16, audio, self._rate, self._channels)

    async def stop(self) -> None:
        await asyncio.to_thread(self._duplex.close)


class _Loudspeaker(_Filter):
    async def filter(self, audio: bytes) -> bytes:
        self._duplex.play_pcm16(audio, self._rate, self._channels)
        return audio


class _HumanVAD(VADAnalyzer):
    """Confidence 1 while the filter's human_speaks holds, else 0: the thresholds are those of its BargeInSettings."""

    def __init__(self, ego: EgoFilter, params: VADParams | None) -> None:
        super().__init__(params=params or VADParams(confidence=0.5, start_secs=0.0, min_volume=0.0))
        self._ego = ego

    def num_frames_required(self) -> int:
        return self._ego.hop * self.sample_rate // SAMPLE_RATE

    def voice_confidence(self, buffer: bytes) -> float:
        return float(self._ego.human_speaks)
