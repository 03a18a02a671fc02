"""A LiveKit agent that can be interrupted: it talks, a human talks over it, it falls silent and understands.

    python agent_livekit.py [WHISPER]

Needs `pip install '.[livekit]'` in a checkout, and for the words faster-whisper with a model (a folder, or a name such
as base). There is no server: the session is a real one, its microphone and its loudspeaker are those of the simulated room
of room.py. In a room of a server the processor goes where the session is started:

    audio = room_io.AudioInputOptions(noise_cancellation=ears, sample_rate=16000)
    await session.start(agent, room=ctx.room, room_options=room_io.RoomOptions(audio_input=audio))
    session.output.audio = ears.tap(session.output.audio)
"""

import asyncio
import sys
from collections import deque

import numpy as np
from livekit import rtc
from livekit.agents import Agent, AgentSession
from livekit.agents.voice import io
from room import PROFILE, RATE, ROBOT, Room
from words import Words

from edgefilter import EgoFilter
from edgefilter.integrations.duplex import as_pcm16, from_pcm16
from edgefilter.integrations.livekit import EgoProcessor

BLOCK = RATE // 50  # 20 ms
HUMAN_AT_S, END_S = 3.0, 10.0


def frame_of(samples):
    return rtc.AudioFrame(as_pcm16(samples), RATE, 1, samples.size)


class Microphone(io.AudioInput):
    """The room's microphone; lets time pass, as fast as the session listens, and keeps what it gave."""

    def __init__(self, room, ears, loudspeaker):
        super().__init__(label="microphone")
        self.room, self.ears, self.loudspeaker = room, ears, loudspeaker
        self.heard, self.over = [], asyncio.Event()

    async def __anext__(self):
        await asyncio.sleep(0.003)
        if self.room.now >= END_S * RATE:
            self.over.set()
            raise StopAsyncIteration
        if self.room.now == HUMAN_AT_S * RATE:
            self.room.speak()
        self.loudspeaker.step()
        frame = self.ears._process(frame_of(self.room.hear(BLOCK)))  # as rtc.AudioStream does with noise_cancellation
        self.heard.append(from_pcm16(frame.data.cast("B")))
        return frame


class Loudspeaker(io.AudioOutput):
    """The room's loudspeaker as the end of the session's output; takes speech faster than it plays."""

    def __init__(self, room):
        super().__init__(label="room", capabilities=io.AudioOutputCapabilities(pause=False), sample_rate=RATE)
        self.room, self.waiting, self.taken, self.complete = room, deque(), 0.0, False

    async def capture_frame(self, frame):
        await super().capture_frame(frame)
        self.waiting.append(from_pcm16(frame.data.cast("B")))
        self.taken += frame.duration

    def flush(self):
        super().flush()
        self.complete = True

    def clear_buffer(self):
        unplayed = (sum(part.size for part in self.waiting) + self.room.buffer.size) / RATE
        self.waiting.clear()
        self.room.silence()
        self.finish(self.taken - unplayed, interrupted=True)

    def step(self):
        while self.waiting and not self.room.full:
            self.room.play(self.waiting.popleft())
        if self.complete and not self.waiting and not self.room.buffer.size:
            self.finish(self.taken, interrupted=False)

    def finish(self, position, interrupted):
        if self.taken:
            self.on_playback_finished(playback_position=position, interrupted=interrupted)
        self.taken, self.complete = 0.0, False


async def speech():
    """The robot's words as a synthesizer gives them: all at once."""
    for at in range(0, ROBOT.size, 4 * BLOCK):
        yield frame_of(ROBOT[at : at + 4 * BLOCK])


async def converse(ego, words=Words(None), room=None):
    """What happened, [(seconds, what)], the room and the processor."""
    room, log, began = room or Room(), [], 0
    session = AgentSession(vad=None, turn_handling={"turn_detection": "manual"})

    def tell(what):
        log.append((round(room.now / RATE, 2), what))

    def on_event(event):
        nonlocal began
        if event.kind == "speech_started":
            tell("the human speaks")
            began = max(0, len(microphone.heard) - 25)  # half a second before
            session.interrupt()
        elif event.kind == "speech_stopped":
            tell(f"the human said: {words(np.concatenate(microphone.heard[began:]))}")

    ears = EgoProcessor(ego, on_event)
    loudspeaker = Loudspeaker(room)
    microphone = Microphone(room, ears, loudspeaker)
    session.input.audio = microphone
    session.output.audio = ears.tap(loudspeaker)
    await session.start(Agent(instructions="Talk."))
    said = session.say("At last.", audio=speech())
    said.add_done_callback(
        lambda handle: tell("the robot was interrupted" if handle.interrupted else "the robot ended")
    )
    await microphone.over.wait()
    await session.aclose()
    return log, room, ears


if __name__ == "__main__":
    log, room, ears = asyncio.run(converse(EgoFilter(PROFILE), Words(*sys.argv[1:2])))
    for seconds, what in log:
        print(f"{seconds:5.2f} s: {what}")
    stats = ears.duplex.stats()
    print(f"played {stats['played_s']:.2f} of {ROBOT.size / RATE:.2f} s")
