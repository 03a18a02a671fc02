"""A Pipecat agent that can be interrupted: it talks, a human talks over it, it falls silent and understands.

    python agent_pipecat.py [WHISPER]

Needs `pip install '.[pipecat]'` in a checkout, and for the words faster-whisper with a model (a folder, or a name such
as base). The transport is the simulated room of room.py; with devices it is a line, and the rest stays:

    params = LocalAudioTransportParams(audio_in_enabled=True, audio_out_enabled=True, **ears.params)
"""

import asyncio
import sys

import numpy as np
from pipecat.frames.frames import (
    BotStartedSpeakingFrame,
    BotStoppedSpeakingFrame,
    InputAudioRawFrame,
    TTSAudioRawFrame,
    TTSStoppedFrame,
    VADUserStartedSpeakingFrame,
    VADUserStoppedSpeakingFrame,
)
from pipecat.pipeline.pipeline import Pipeline
from pipecat.pipeline.worker import PipelineWorker
from pipecat.processors.audio.vad_processor import VADProcessor
from pipecat.processors.frame_processor import FrameProcessor
from pipecat.transports.base_input import BaseInputTransport
from pipecat.transports.base_output import BaseOutputTransport
from pipecat.transports.base_transport import TransportParams
from pipecat.workers.runner import WorkerRunner
from room import PROFILE, RATE, ROBOT, Room
from words import Words

from edgefilter import EgoFilter
from edgefilter.integrations.duplex import as_pcm16, from_pcm16
from edgefilter.integrations.pipecat import EgoFilters

BLOCK = RATE // 50  # 20 ms
HUMAN_AT_S, END_S = 3.0, 10.0


class RoomInput(BaseInputTransport):
    """The room's microphone: lets time pass, as fast as the pipeline follows."""

    def __init__(self, room, params, over):
        super().__init__(params)
        self.room, self.over = room, over

    async def start(self, frame):
        await super().start(frame)
        await self.set_transport_ready(frame)
        self.create_task(self._listen())

    async def _listen(self):
        while self.room.now < END_S * RATE:
            if self.room.now == HUMAN_AT_S * RATE:
                self.room.speak()
            await self.push_audio_frame(InputAudioRawFrame(as_pcm16(self.room.hear(BLOCK)), RATE, 1))
            await self._audio_in_queue.join()
            await asyncio.sleep(0.002)
        self.over.set()


class RoomOutput(BaseOutputTransport):
    """The room's loudspeaker: takes audio while there is room in its buffer."""

    def __init__(self, room, params):
        super().__init__(params)
        self.room = room

    async def start(self, frame):
        await super().start(frame)
        await self.set_transport_ready(frame)

    async def write_audio_frame(self, frame):
        while self.room.full:
            await asyncio.sleep(0.001)
        self.room.play(from_pcm16(frame.audio))
        return True


class Agent(FrameProcessor):
    """Stops talking when the human begins, and hears what is said until the human has ended."""

    def __init__(self, room, words, log):
        super().__init__()
        self.room, self.words, self.log = room, words, log
        self.heard, self.listening = [], False

    async def process_frame(self, frame, direction):
        await super().process_frame(frame, direction)
        if isinstance(frame, InputAudioRawFrame):
            self.heard = [*(self.heard if self.listening else self.heard[-25:]), from_pcm16(frame.audio)]
        elif isinstance(frame, VADUserStartedSpeakingFrame):
            self.listening = True
            self.tell("the human speaks")
            await self.broadcast_interruption()
        elif isinstance(frame, VADUserStoppedSpeakingFrame):
            self.listening = False
            self.tell(f"the human said: {self.words(np.concatenate(self.heard))}")
        elif isinstance(frame, BotStartedSpeakingFrame):
            self.tell("the robot speaks")
        elif isinstance(frame, BotStoppedSpeakingFrame):
            self.tell("the robot is silent")
        await self.push_frame(frame, direction)

    def tell(self, what):
        self.log.append((round(self.room.now / RATE, 2), what))


async def converse(ego, words=Words(None), room=None):
    """What happened, [(seconds, what)], the room and the filters."""
    room, log, over = room or Room(), [], asyncio.Event()
    ears = EgoFilters(ego)
    params = TransportParams(
        audio_in_enabled=True,
        audio_out_enabled=True,
        audio_in_sample_rate=RATE,
        audio_out_sample_rate=RATE,
        audio_out_end_silence_secs=0,
        **ears.params,
    )
    output = RoomOutput(room, params)
    turns = VADProcessor(vad_analyzer=ears.vad())
    worker = PipelineWorker(Pipeline([RoomInput(room, params, over), turns, Agent(room, words, log), output]))
    runner = WorkerRunner(handle_sigint=False)
    await runner.add_workers(worker)
    running = asyncio.create_task(runner.run())
    await worker.queue_frames([TTSAudioRawFrame(as_pcm16(ROBOT), RATE, 1), TTSStoppedFrame()])  # all of it at once
    await over.wait()
    await worker.cancel()
    await running
    return log, room, ears


if __name__ == "__main__":
    log, room, ears = asyncio.run(converse(EgoFilter(PROFILE), Words(*sys.argv[1:2])))
    for seconds, what in log:
        print(f"{seconds:5.2f} s: {what}")
    stats = ears.duplex.stats()
    print(f"played {stats['played_s']:.2f} of {ROBOT.size / RATE:.2f} s")
