"""LiveKit Agents: a frame processor for the room's microphone, and a tap on what the agent says.

    ears = EgoProcessor(EgoFilter("robot.npz", budget_ms=8))
    audio = room_io.AudioInputOptions(noise_cancellation=ears, sample_rate=16000)
    await session.start(agent, room=ctx.room, room_options=room_io.RoomOptions(audio_input=audio))
    session.output.audio = ears.tap(session.output.audio)

Needs `pip install edgefilter[livekit]`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from livekit import rtc
from livekit.agents.voice import io

from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex, as_pcm16, from_pcm16
from edgefilter.types import Event

ROOM_HOLDS_S = 0.2
"""What a room's output has in its source and throws away when it is paused (room_io: queue_size_ms). Where a sink keeps
it, the reference is early by so much, which the aligner finds."""


class EgoProcessor(rtc.FrameProcessor[rtc.AudioFrame]):
    """The robot's own voice out of a LiveKit room's microphone, for `AudioInputOptions(noise_cancellation=...)`.

    Frames come out as long as they went in. Until the filter's first samples are out, and where it later has too few
    for a frame, silence stands in front of them.

    Parameters
    ----------
    ego : EgoFilter, optional
        As of `edgefilter.integrations.duplex.Duplex`.
    on_event : callable, optional
        Called with each `edgefilter.Event`, in the event loop: `session.interrupt()` may be called there.

    Attributes
    ----------
    duplex : Duplex
        What processor and tap share: `duplex.stats()`, `duplex.ego`.
    """

    def __init__(self, ego: EgoFilter | None = None, on_event: Callable[[Event], None] | None = None) -> None:
        self.duplex = Duplex(ego, on_event=on_event)
        self._ready = np.zeros(0, np.float32)

    def tap(self, output: io.AudioOutput) -> io.AudioOutput:
        """What the session says through output, noted on its way: to become `session.output.audio`."""
        return _Tap(self.duplex, output)

    @property
    def enabled(self) -> bool:
        """Whether the microphone is filtered."""
        return self.duplex.enabled

    @enabled.setter
    def enabled(self, value: bool) -> None:
        self.duplex.enabled = value

    def _process(self, frame: rtc.AudioFrame) -> rtc.AudioFrame:
        count = frame.samples_per_channel
        human = self.duplex.hear(from_pcm16(frame.data.cast("B"), frame.num_channels), frame.sample_rate)
        missing = np.zeros(max(0, count - self._ready.size - human.size), np.float32)
        ready = np.concatenate((missing, self._ready, human))
        self._ready = ready[count:]
        pcm = as_pcm16(ready[:count], frame.num_channels)
        return rtc.AudioFrame(pcm, frame.sample_rate, frame.num_channels, count, userdata=frame.userdata)

    def _close(self) -> None:
        self.duplex.close()


class _Tap(io.AudioOutput):
    """Hands everything on to the next output and tells the duplex; frames may come faster than they are played."""

    def __init__(self, duplex: Duplex, output: io.AudioOutput) -> None:
        able = io.AudioOutputCapabilities(pause=True)
        super().__init__(label="edgefilter", capabilities=able, next_in_chain=output, sample_rate=output.sample_rate)
        self._duplex = duplex

    @property
    def _next(self) -> io.AudioOutput:
        assert self.next_in_chain is not None
        return self.next_in_chain

    async def capture_frame(self, frame: rtc.AudioFrame) -> None:
        """Hand on first: the room takes nothing before somebody listens."""
        await super().capture_frame(frame)
        await self._next.capture_frame(frame)
        self._duplex.play(from_pcm16(frame.data.cast("B"), frame.num_channels), frame.sample_rate)

    def flush(self) -> None:
        super().flush()
        self._duplex.end()
        self._next.flush()

    def clear_buffer(self) -> None:
        self._duplex.interrupt()
        self._next.clear_buffer()

    def pause(self) -> None:
        self._duplex.pause()
        super().pause()

    def resume(self) -> None:
        self._duplex.resume(skipped_s=ROOM_HOLDS_S)
        super().resume()
