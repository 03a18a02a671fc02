"""LiveKit Agents: a frame processor for the room's microphone, and a tap on what the agent says.

    ears = EgoProcessor(EgoFilter("robot.npz"))
    audio = room_io.AudioInputOptions(noise_cancellation=ears, sample_rate=16000)
    await session.start(agent, room=ctx.room, room_options=room_io.RoomOptions(audio_input=audio))
    session.output.audio = ears.tap(session.output.audio)

Needs `pip install '.[livekit]'` in a checkout.
"""

from __future__ import annotations

from collections.abc import Callable

from livekit import rtc
from livekit.agents.voice import io

from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex
from edgefilter.types import Event

ROOM_HOLDS_S = 0.2
"""Speech that a room's output holds ahead and throws away when it is paused (room_io: queue_size_ms). Behind a sink that
keeps it the reference is early by so much, which the aligner finds."""


class EgoProcessor(rtc.FrameProcessor[rtc.AudioFrame]):
    """Removes the robot's voice from a LiveKit room's microphone, for `AudioInputOptions(noise_cancellation=...)`.

    Frames come out as long as they went in: while the filter has too few samples for a frame, silence is put in front.

    Parameters
    ----------
    ego : EgoFilter, optional
        As of `edgefilter.integrations.duplex.Duplex`.
    on_event : callable, optional
        Called with each `edgefilter.Event`, in the event loop: `session.interrupt()` may be called there.

    Attributes
    ----------
    duplex : Duplex
        Shared by the processor and its tap: `duplex.stats()`, `duplex.ego`.
    """

    def __init__(self, ego: EgoFilter | None = None, on_event: Callable[[Event], None] | None = None) -> None:
        self.duplex = Duplex(ego, patience_s=0.0, on_event=on_event)  # the room holds speech ahead: none is late
        self._ready = b""

    def tap(self, output: io.AudioOutput) -> io.AudioOutput:
        """Return an output, for `session.output.audio`, that hands speech on to this one and takes it as reference."""
        return _Tap(self.duplex, output)

    @property
    def enabled(self) -> bool:
        """Whether the microphone is filtered."""
        return self.duplex.enabled

    @enabled.setter
    def enabled(self, value: bool) -> None:
        self.duplex.enabled = value

    def _process(self, frame: rtc.AudioFrame) -> rtc.AudioFrame:
        pcm, form = frame.data.cast("B"), (frame.sample_rate, frame.num_channels)
        ready = (self._ready + self.duplex.hear_pcm16(pcm, *form)).rjust(pcm.nbytes, b"\0")
        self._ready = ready[pcm.nbytes :]
        return rtc.AudioFrame(ready[: pcm.nbytes], *form, frame.samples_per_channel, userdata=frame.userdata)

    def _close(self) -> None:
        self.duplex.close()


class _Tap(io.AudioOutput):
    """Hands everything on to the next output and tells the duplex."""

    def __init__(self, duplex: Duplex, output: io.AudioOutput) -> None:
        able = io.AudioOutputCapabilities(pause=True)
        super().__init__(label="edgefilter", capabilities=able, next_in_chain=output, sample_rate=output.sample_rate)
        self._duplex = duplex

    @property
    def _next(self) -> io.AudioOutput:
        assert self.next_in_chain is not None
        return self.next_in_chain

    async def capture_frame(self, frame: rtc.AudioFrame) -> None:
        """Hand on first: a room waits here until somebody listens."""
        await super().capture_frame(frame)
        await self._next.capture_frame(frame)
        self._duplex.play_pcm16(frame.data.cast("B"), frame.sample_rate, frame.num_channels)

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
