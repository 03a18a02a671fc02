r"""A Wyoming satellite that can be interrupted: it talks, a human talks over it, it falls silent and understands.

    python agent_wyoming.py [WHISPER]

Needs `pip install '.[wyoming]'` in a checkout, and for the words faster-whisper with a model (a folder, or a name such
as base). Everything goes through TCP: the simulated room of room.py is a microphone and a loudspeaker service, as
wyoming-mic-external and wyoming-snd-external are; edgefilter's service stands before them; and this program is the
satellite, which speaks and listens through it. On a robot:

    python -m edgefilter.integrations.wyoming --microphone 'arecord -q -r 16000 -c 1 -f S16_LE -t raw' \
        --loudspeaker 'aplay -q -r 22050 -c 1 -f S16_LE -t raw' --profile robot.npz --stop-for-speech
    wyoming-satellite --mic-uri tcp://127.0.0.1:10600 --snd-uri tcp://127.0.0.1:10601 ...
"""

import asyncio
import sys
from contextlib import suppress
from functools import partial

import numpy as np
from room import PROFILE, RATE, ROBOT, Room
from words import Words
from wyoming.audio import AudioChunk, AudioStart, AudioStop
from wyoming.client import AsyncClient
from wyoming.server import AsyncEventHandler, AsyncServer
from wyoming.snd import Played
from wyoming.vad import VoiceStarted, VoiceStopped

from edgefilter import EgoFilter
from edgefilter.integrations.duplex import as_pcm16, from_pcm16
from edgefilter.integrations.wyoming import EgoService

BLOCK = 1024  # 64 ms, as satellites read
HUMAN_AT_S, END_S = 3.2, 10.24


class RoomMicrophone(AsyncEventHandler):
    """The room's microphone as a service; time passes as fast as the satellite listens."""

    def __init__(self, room, listened, reader, writer):
        super().__init__(reader, writer)
        self.room, self.listened = room, listened
        self.task = asyncio.create_task(self.listen())

    async def handle_event(self, event):
        return True

    async def listen(self):
        while self.room.now < END_S * RATE:
            if self.room.now == HUMAN_AT_S * RATE:
                self.room.speak()
            heard = as_pcm16(self.room.hear(BLOCK))
            await self.write_event(AudioChunk(RATE, 2, 1, heard).event())
            with suppress(TimeoutError, asyncio.TimeoutError):  # time passes even if nobody listens
                await asyncio.wait_for(self.listened.get(), 0.5)  # less than a microphone that is off


class RoomLoudspeaker(AsyncEventHandler):
    """The room's loudspeaker as a service, silent as soon as its client has gone."""

    def __init__(self, room, reader, writer):
        super().__init__(reader, writer)
        self.room, self.complete = room, False

    async def handle_event(self, event):
        self.complete = AudioStop.is_type(event.type)
        if AudioChunk.is_type(event.type):
            self.room.play(from_pcm16(AudioChunk.from_event(event).audio))
        return True

    async def disconnect(self):
        if not self.complete:
            self.room.silence()


async def connected(uri):
    """A client of a service that may still be starting."""
    while True:
        try:
            client = AsyncClient.from_uri(uri)
            await client.connect()
            return client
        except OSError:
            await asyncio.sleep(0.05)


async def speak(uri):
    """What a satellite does with the answer it is to give: all of it at once, then it waits until it was played."""
    client = await connected(uri)
    await client.write_event(AudioStart(RATE, 2, 1).event())
    for at in range(0, ROBOT.size, BLOCK):
        await client.write_event(AudioChunk(RATE, 2, 1, as_pcm16(ROBOT[at : at + BLOCK])).event())
    await client.write_event(AudioStop().event())
    while not Played.is_type((await client.read_event()).type):
        pass
    await client.disconnect()


async def converse(ego, words=Words(None), room=None, port=10600):
    """What happened, [(seconds, what)], the room and the service."""
    room, log, listened = room or Room(), [], asyncio.Queue()
    ports = [f"tcp://127.0.0.1:{port + i}" for i in range(4)]
    microphone, loudspeaker = (AsyncServer.from_uri(uri) for uri in ports[2:])
    await microphone.start(partial(RoomMicrophone, room, listened))
    await loudspeaker.start(partial(RoomLoudspeaker, room))
    service = EgoService(ports[2], ports[3], ego, stop_for_speech=True)
    serving = asyncio.create_task(service.run(ports[0], ports[1]))
    client, speaking = await connected(ports[0]), asyncio.create_task(speak(ports[1]))
    speaking.add_done_callback(lambda _: log.append((round(room.now / RATE, 2), "the robot is silent")))
    heard, began = [], 0
    while room.now < END_S * RATE:
        message = await client.read_event()
        if AudioChunk.is_type(message.type):
            heard.append(from_pcm16(message.payload))
            await asyncio.sleep(0.005)
            listened.put_nowait(None)
        elif VoiceStarted.is_type(message.type):
            log.append((round(room.now / RATE, 2), "the human speaks"))
            began = max(0, len(heard) - 8)  # half a second before
        elif VoiceStopped.is_type(message.type):
            said = words(np.concatenate(heard[began:]))
            log.append((round(room.now / RATE, 2), f"the human said: {said}"))
    await client.disconnect()
    serving.cancel()
    await asyncio.gather(serving, speaking, return_exceptions=True)
    for server in (microphone, loudspeaker):
        await server.stop()
    return log, room, service


if __name__ == "__main__":
    log, room, service = asyncio.run(converse(EgoFilter(PROFILE), Words(*sys.argv[1:2])))
    for seconds, what in log:
        print(f"{seconds:5.2f} s: {what}")
    stats = service.duplex.stats()
    print(f"played {stats['played_s']:.2f} of {ROBOT.size / RATE:.2f} s")
