"""LiveKit Agents: a frame processor for the room's microphone, and a tap on what the agent says.

    ears = EgoProcessor(EgoFilter("robot.npz"))
    audio = room_io.AudioInputOptions(noise_cancellation=ears, sample_rate=16000)
    await session.start(agent, room=ctx.room, room_options=room_io.RoomOptions(audio_input=audio))
    session.output.audio = ears.tap(session.output.audio)

Needs `pip install '.[livekit]'` in a checkout.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence

from livekit import rtc
from livekit.agents import vad
from livekit.agents.voice import io

from edgefilter.audio.channels import Channels
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex, as_pcm16, from_pcm16
from edgefilter.integrations.turns import TurnByTurn
from edgefilter.types import SAMPLE_RATE, Event

ROOM_HOLDS_S = 0.2
"""Speech that a room's output holds ahead and throws away when it is paused (room_io: queue_size_ms). Behind a sink that
keeps it the reference is early by so much, which the aligner finds."""


class EgoProcessor(rtc.FrameProcessor[rtc.AudioFrame]):
    """Removes the robot's voice from a LiveKit room's microphone, for `AudioInputOptions(noise_cancellation=...)`.

    Frames come out as long as they went in: while the filter has too few samples for a frame, silence is put in front.

    ego, mic_channels, reference_channel: as of `edgefilter.integrations.duplex.Duplex`, channels of the frames; with a
    reference_channel no tap is needed. on_event: called with each `edgefilter.Event`, in the event loop:
    `session.interrupt()` may be called there. duplex: shared by the processor and its tap: `duplex.stats()`, `duplex.ego`.
    """

    def __init__(
        self,
        ego: EgoFilter | None = None,
        on_event: Callable[[Event], None] | None = None,
        mic_channels: Sequence[int] | None = None,
        reference_channel: int | None = None,
    ) -> None:
        # the room holds speech ahead: none is late
        array = Channels.named(mic_channels, reference_channel)
        self.duplex = Duplex(ego, patience_s=0.0, on_event=on_event, mic_channels=array)
        self._ready = b""

    def tap(self, output: io.AudioOutput) -> io.AudioOutput:
        """Return an output, for `session.output.audio`, that hands speech on to this one and takes it as reference."""
        return _Tap(self.duplex, output)

    def vad(self) -> vad.VAD:
        """Return the filter's own voice activity detection, for `AgentSession` and for `stt.StreamAdapter`.

        A recogniser behind that adapter gets the human's finished turns, one channel: with several microphones they are
        understood better than what was streamed. Raises UsageError where an engine of the filter judges no speech.
        """
        self.duplex.require_judge("vad()")
        return _HumanVAD(self.duplex)

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
        """What the framework puts between: it may wrap the output that it was given."""
        assert self.next_in_chain is not None
        return self.next_in_chain

    async def capture_frame(self, frame: rtc.AudioFrame) -> None:
        """Hand on first: a room waits here until somebody listens."""
        form = frame.sample_rate, frame.num_channels
        frame = rtc.AudioFrame(
            self._duplex.lowered_pcm16(frame.data.cast("B"), *form), *form, frame.samples_per_channel
        )
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


class _HumanVAD(vad.VAD):
    """Speech is what the filter's human_speaks says: the thresholds are those of its BargeInSettings."""

    def __init__(self, duplex: Duplex) -> None:
        super().__init__(capabilities=vad.VADCapabilities(update_interval=duplex.ego.hop / SAMPLE_RATE))
        self._duplex = duplex

    def stream(self) -> vad.VADStream:
        return _HumanStream(self, self._duplex)


class _HumanStream(vad.VADStream):
    def __init__(self, owner: vad.VAD, duplex: Duplex) -> None:
        self._duplex, self._turns = duplex, TurnByTurn(duplex)
        super().__init__(owner)

    async def _main_task(self) -> None:
        speaking, spoke_s, silent_s, samples = False, 0.0, 0.0, 0

        def tell(kind: vad.VADEventType, frames: list[rtc.AudioFrame]) -> None:
            event = vad.VADEvent(
                type=kind, samples_index=samples, timestamp=time.time(), speech_duration=spoke_s,
                silence_duration=silent_s, frames=frames, probability=float(speaking), speaking=speaking,
                raw_accumulated_speech=spoke_s if speaking else 0.0, raw_accumulated_silence=silent_s,
            )  # fmt: skip
            self._event_ch.send_nowait(event)

        try:
            async for frame in self._input_ch:
                if not isinstance(frame, rtc.AudioFrame):  # a hard end of the segment
                    speaking, spoke_s = False, 0.0
                    continue
                samples += frame.samples_per_channel
                self._turns.hear(from_pcm16(frame.data.cast("B"), frame.num_channels), frame.sample_rate)
                before, speaking = speaking, self._duplex.ego.human_speaks
                if speaking and not before:
                    spoke_s = 0.0
                    self._turns.start()
                spoke_s += frame.duration if speaking else 0.0
                silent_s = 0.0 if speaking else silent_s + frame.duration
                if speaking and not before:
                    tell(vad.VADEventType.START_OF_SPEECH, [frame])
                tell(vad.VADEventType.INFERENCE_DONE, [frame])
                if before and not speaking:
                    whole, rate = await asyncio.to_thread(self._turns.take)
                    tell(vad.VADEventType.END_OF_SPEECH, [rtc.AudioFrame(as_pcm16(whole), rate, 1, whole.size)])
                    spoke_s = 0.0
        finally:
            self._turns.close()
