"""Pipecat: one filter for a transport's microphone and loudspeaker, and its voice activity detection.

    ears = EgoFilters(EgoFilter("robot.npz"))
    params = LocalAudioTransportParams(audio_in_enabled=True, audio_out_enabled=True, **ears.params)

Needs `pip install '.[pipecat]'` in a checkout.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pipecat.audio.filters.base_audio_filter import BaseAudioFilter
from pipecat.audio.vad.vad_analyzer import VADAnalyzer, VADParams
from pipecat.frames.frames import (
    FilterControlFrame,
    FilterEnableFrame,
    Frame,
    InputAudioRawFrame,
    VADUserStartedSpeakingFrame,
    VADUserStoppedSpeakingFrame,
)
from pipecat.processors.frame_processor import FrameDirection, FrameProcessor

from edgefilter.audio.channels import Channels
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex, as_pcm16, from_pcm16
from edgefilter.integrations.turns import TurnByTurn
from edgefilter.types import SAMPLE_RATE, Event

_LOGGER = logging.getLogger(__name__)


class EgoFilters:
    """Removes the robot's voice from a Pipecat transport's microphone.

    Two Pipecat filters share one EgoFilter: the one of the loudspeaker takes what is written to it as the reference, and
    lowers it where the filter asks for that (`BargeInSettings.ask_db`), the one of the microphone filters.

    ego, mic_channels, reference_channel: as of `edgefilter.integrations.duplex.Duplex`, channels of the in_channels.
    in_channels, out_channels: of the transport's microphone and loudspeaker, of which Pipecat tells a filter nothing.
    on_event: called with each `edgefilter.Event`, in a thread of the event loop's executor. params: for
    `TransportParams(**params)`, filter and channels of the microphone and of the loudspeaker. duplex: shared by both
    filters: `duplex.stats()`, `duplex.ego`.
    """

    def __init__(
        self,
        ego: EgoFilter | None = None,
        in_channels: int = 1,
        out_channels: int = 1,
        on_event: Callable[[Event], None] | None = None,
        mic_channels: Sequence[int] | None = None,
        reference_channel: int | None = None,
    ) -> None:
        array = Channels.named(mic_channels, reference_channel, in_channels)
        self.duplex = Duplex(ego, on_event=on_event, mic_channels=array)
        self.params: dict[str, Any] = {
            "audio_in_filter": _Microphone(self.duplex, in_channels),
            "audio_in_channels": in_channels,
            "audio_out_filter": _Loudspeaker(self.duplex, out_channels),
            "audio_out_channels": out_channels,
        }

    def vad(self, params: VADParams | None = None) -> VADAnalyzer:
        """Return the filter's own voice activity detection, as the `vad_analyzer` of Pipecat's user turns.

        It replaces Silero, which takes what is left of the robot's voice for a human. Raises UsageError where an engine
        of the filter judges no speech.
        """
        self.duplex.require_judge("vad()")
        return _HumanVAD(self.duplex.ego, params)

    def turns(self) -> FrameProcessor:
        """Return a processor to put between voice activity detection and a segmented recogniser, which then gets turns.

        It holds the sound back and hands on the human's finished turn, one channel, just before the frame that says that
        the human has stopped: with several microphones it is understood better than what was streamed.
        """
        return _Turns(self.duplex)


class _Filter(BaseAudioFilter):
    """The common part of both filters: the rate; a FilterEnableFrame for either of them concerns both."""

    def __init__(self, duplex: Duplex, channels: int) -> None:
        self._duplex, self._channels, self._rate = duplex, channels, SAMPLE_RATE

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
        if self._channels == 1 and in_pairs(audio):
            self._channels = 2
            _LOGGER.warning(
                "the loudspeaker has two equal channels, not one as was said: give EgoFilters out_channels=2"
            )
        audio = bytes(self._duplex.lowered_pcm16(audio, self._rate, self._channels))
        self._duplex.play_pcm16(audio, self._rate, self._channels)
        return audio


def in_pairs(pcm: bytes) -> bool:
    """Whether 16-bit sound has each sample twice, as one voice on two channels has: taken for one, it would last twice as long.

    >>> in_pairs(np.repeat(np.arange(160, dtype="<i2"), 2).tobytes()), in_pairs(np.arange(320, dtype="<i2").tobytes())
    (True, False)
    """
    samples = np.frombuffer(pcm, "<i2")
    pairs = samples[: samples.size // 2 * 2].reshape(-1, 2)
    return len(np.unique(samples)) > len(pairs) // 4 and bool((pairs[:, 0] == pairs[:, 1]).all())


class _HumanVAD(VADAnalyzer):
    """Confidence 1 while the filter's human_speaks holds, else 0: the thresholds are those of its BargeInSettings."""

    def __init__(self, ego: EgoFilter, params: VADParams | None) -> None:
        super().__init__(params=params or VADParams(confidence=0.5, start_secs=0.0, min_volume=0.0))
        self._ego = ego

    def num_frames_required(self) -> int:
        return self._ego.hop * self.sample_rate // SAMPLE_RATE

    def voice_confidence(self, buffer: bytes) -> float:
        return float(self._ego.human_speaks)


class _Turns(FrameProcessor):
    def __init__(self, duplex: Duplex) -> None:
        super().__init__()
        self._turns = TurnByTurn(duplex)
        self._latest: InputAudioRawFrame | None = None

    async def process_frame(self, frame: Frame, direction: FrameDirection) -> None:
        await super().process_frame(frame, direction)
        if isinstance(frame, InputAudioRawFrame):
            self._latest = frame
            self._turns.hear(from_pcm16(frame.audio, frame.num_channels), frame.sample_rate)
            return
        if isinstance(frame, VADUserStartedSpeakingFrame):
            self._turns.start()
        elif isinstance(frame, VADUserStoppedSpeakingFrame) and self._latest is not None:
            samples, _ = await asyncio.to_thread(self._turns.take)
            if samples.size:
                await self.push_frame(replace(self._latest, audio=as_pcm16(samples), num_channels=1), direction)
        await self.push_frame(frame, direction)

    async def cleanup(self) -> None:
        await super().cleanup()
        self._turns.close()
