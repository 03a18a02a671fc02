r"""Wyoming: microphone and loudspeaker of a Home Assistant satellite, with the robot's own voice out of the microphone.

    python -m edgefilter.integrations.wyoming --microphone 'arecord -q -r 16000 -c 1 -f S16_LE -t raw' \
        --loudspeaker 'aplay -q -r 22050 -c 1 -f S16_LE -t raw' --profile robot.npz
    wyoming-satellite --mic-uri tcp://127.0.0.1:10600 --snd-uri tcp://127.0.0.1:10601 ...

Needs `pip install edgefilter[wyoming]`.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import sys
import time
from functools import partial

from wyoming.audio import AudioChunk, AudioChunkConverter, AudioFormat, AudioStart, AudioStop
from wyoming.event import Event as Message
from wyoming.info import Attribution, Describe, Info, MicProgram, SndProgram
from wyoming.server import AsyncEventHandler, AsyncServer
from wyoming.snd import Played
from wyoming.vad import VoiceStarted, VoiceStopped

from edgefilter import __version__
from edgefilter.errors import EdgefilterError
from edgefilter.filter.budget import DEFAULT_MS
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex, as_pcm16, from_pcm16
from edgefilter.integrations.wyoming_sound import Player, open_microphone
from edgefilter.types import Event

RECONNECT_S = 3.0
MOST_WAITING = 64
"""Messages that a listener may be behind, 4 s of 64 ms; of one that is slower the oldest are left out."""
MOST_SAID = 10_000
"""Messages of one who speaks that wait for their turn, about ten minutes; then its connection is read no further."""
AHEAD_S = 0.5
"""Speech that is handed to the loudspeaker before its turn: what is further ahead is still here when it is dropped."""
MIC_URI, SND_URI = "tcp://127.0.0.1:10600", "tcp://127.0.0.1:10601"
ABOUT = {
    "attribution": Attribution("edgefilter", "https://pypi.org/project/edgefilter"),
    "installed": True,
    "description": "The robot's own voice out of its microphone",
    "version": __version__,
}
_LOGGER = logging.getLogger(__name__)


class EgoService:
    """Two Wyoming services over one filter: a microphone that many may listen to, and a loudspeaker.

    Parameters
    ----------
    microphone, loudspeaker : str
        Where sound comes from and goes to: a command that writes or reads raw 16-bit samples, or the URI of another
        Wyoming service (`tcp://...`, `unix://...`).
    ego : EgoFilter, optional
        As of `edgefilter.integrations.duplex.Duplex`.
    mic_format, snd_format : AudioFormat
        What the commands write and read.
    stop_for_speech : bool
        Whether what is being played ends when the human begins to speak. The protocol has no word for it, so that a
        satellite cannot do it.

    Notes
    -----
    The microphone is filtered whether somebody listens or not, so that the room is known when somebody does. Listeners
    also get `voice-started` and `voice-stopped` of the human. Who disconnects from the loudspeaker before its
    `audio-stop` interrupts: what is not played yet is dropped.
    """

    def __init__(
        self,
        microphone: str,
        loudspeaker: str,
        ego: EgoFilter | None = None,
        mic_format: AudioFormat = AudioFormat(16_000, 2, 1),
        snd_format: AudioFormat = AudioFormat(22_050, 2, 1),
        stop_for_speech: bool = False,
    ) -> None:
        self._heard: list[Event] = []
        self.duplex = Duplex(ego, on_event=self._heard.append)
        self.mic_format = mic_format
        self.player = Player(loudspeaker, snd_format)
        self._microphone = microphone
        self._stop_for_speech = stop_for_speech
        self._to_mono16 = AudioChunkConverter(width=2, channels=1)
        self.listeners: set[_Listener] = set()
        self.speakers: set[_Speaker] = set()

    async def run(self, mic_uri: str = MIC_URI, snd_uri: str = SND_URI) -> None:
        """Serve both until cancelled."""
        servers = [AsyncServer.from_uri(uri) for uri in (mic_uri, snd_uri)]
        try:
            await asyncio.gather(
                servers[0].run(partial(_Listener, self)), servers[1].run(partial(_Speaker, self)), self._listen()
            )
        finally:
            await self.player.stop()
            for server in servers:
                await server.stop()
            await asyncio.to_thread(self.duplex.close)

    async def say(self, chunk: AudioChunk) -> None:
        """Hand a piece of speech to the loudspeaker as its turn comes; without a microphone at the real pace."""
        until = time.monotonic() + chunk.seconds
        while self.duplex.queued_s > AHEAD_S and time.monotonic() < until:
            await asyncio.sleep(0.005)
        mono = self._to_mono16.convert(chunk)
        self.duplex.play(from_pcm16(mono.audio), mono.rate)
        try:
            await self.player.write(chunk)
        except OSError as error:
            _LOGGER.warning("loudspeaker %s cannot be reached (%s): nothing is heard of this", self.player.where, error)
            await self.interrupt()

    async def finish(self) -> None:
        """The utterance is complete; returns when it has been played."""
        self.duplex.end()
        await self.player.end()
        await asyncio.sleep(self.duplex.queued_s)

    async def interrupt(self) -> None:
        """End what is being played, and drop what was not played yet, here and with all who speak."""
        for speaker in self.speakers:
            speaker.drop()
        self.duplex.interrupt()
        await self.player.stop()

    async def _listen(self) -> None:
        """Read the microphone for ever; one that ends or fails is opened again."""
        while True:
            try:
                async with open_microphone(self._microphone, self.mic_format) as client:
                    while (message := await client.read_event()) is not None:
                        if AudioChunk.is_type(message.type):
                            await self._hear(self._to_mono16.convert(AudioChunk.from_event(message)))
                why = "ended"
            except (OSError, EOFError, ValueError) as error:
                why = f"cannot be read ({error})"
            _LOGGER.warning("microphone %s %s: again in %.0f s", self._microphone, why, RECONNECT_S)
            await asyncio.sleep(RECONNECT_S)

    async def _hear(self, chunk: AudioChunk) -> None:
        human = await asyncio.to_thread(self.duplex.hear, from_pcm16(chunk.audio), chunk.rate)
        if human.size:
            self._tell(AudioChunk(chunk.rate, 2, 1, as_pcm16(human), chunk.timestamp).event())
        while self._heard:
            kind = self._heard.pop(0).kind
            if kind == "speech_started":
                self._tell(VoiceStarted(chunk.timestamp).event())
                if self._stop_for_speech:
                    await self.interrupt()
            elif kind == "speech_stopped":
                self._tell(VoiceStopped(chunk.timestamp).event())

    def _tell(self, message: Message) -> None:
        for listener in self.listeners:
            listener.send(message)


class _Listener(AsyncEventHandler):
    """One who listens to the microphone."""

    def __init__(self, service: EgoService, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(reader, writer)
        self._service = service
        self._waiting: asyncio.Queue[Message] = asyncio.Queue(MOST_WAITING)
        self._task = asyncio.create_task(self._write())
        service.listeners.add(self)

    def send(self, message: Message) -> None:
        if self._waiting.full():
            self._waiting.get_nowait()
        self._waiting.put_nowait(message)

    async def handle_event(self, event: Message) -> bool:
        if Describe.is_type(event.type):
            self.send(Info(mic=[MicProgram(name="edgefilter", mic_format=self._service.mic_format, **ABOUT)]).event())
        return True

    async def _write(self) -> None:
        try:
            while True:
                await self.write_event(await self._waiting.get())
        except ConnectionError:
            pass  # it has gone; run() notices as well and disconnects

    async def disconnect(self) -> None:
        self._service.listeners.discard(self)
        self._task.cancel()


class _Speaker(AsyncEventHandler):
    """One who speaks through the loudspeaker; what it says waits here, so that its end is noticed in time."""

    def __init__(self, service: EgoService, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(reader, writer)
        self._service = service
        self._said: asyncio.Queue[Message | None] = asyncio.Queue(MOST_SAID)
        self._speaking = self._ignored = False
        self._task = asyncio.create_task(self._speak())
        service.speakers.add(self)

    def drop(self) -> None:
        """Forget what waits, and what else comes of this utterance; its end is still answered."""
        self._ignored = self._speaking
        waiting = [self._said.get_nowait() for _ in range(self._said.qsize())]
        for message in waiting:
            if message is None or AudioStop.is_type(message.type):
                self._said.put_nowait(message)

    async def handle_event(self, event: Message) -> bool:
        if AudioStart.is_type(event.type):
            self._ignored = False
        elif AudioStop.is_type(event.type) or (AudioChunk.is_type(event.type) and not self._ignored):
            self._speaking = not AudioStop.is_type(event.type)
            await self._said.put(event)
        elif Describe.is_type(event.type):
            form = self._service.player.form
            await self.write_event(Info(snd=[SndProgram(name="edgefilter", snd_format=form, **ABOUT)]).event())
        return True

    async def _speak(self) -> None:
        try:
            while (message := await self._said.get()) is not None:
                if AudioChunk.is_type(message.type):
                    await self._service.say(AudioChunk.from_event(message))
                else:
                    self._ignored = False
                    await self._service.finish()
                    await self.write_event(Played().event())
        except ConnectionError:
            pass  # it has gone and does not care when the end was played
        finally:
            self._service.speakers.discard(self)

    async def disconnect(self) -> None:
        if self._speaking:
            self._task.cancel()
            await self._service.interrupt()
        else:
            await self._said.put(None)


def main(words: list[str] | None = None) -> int:
    """Parse the command line and serve; one line and exit code 1 where that fails."""
    parser = argparse.ArgumentParser(
        prog="python -m edgefilter.integrations.wyoming", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--microphone", required=True, help="command that writes raw 16-bit samples, or a URI")
    parser.add_argument("--loudspeaker", required=True, help="command that reads raw 16-bit samples, or a URI")
    parser.add_argument("--mic-rate", type=int, default=16_000, help="of the command")
    parser.add_argument("--mic-channels", type=int, default=1, help="of the command")
    parser.add_argument("--snd-rate", type=int, default=22_050, help="of the command")
    parser.add_argument("--snd-channels", type=int, default=1, help="of the command")
    parser.add_argument("--profile", help="the calibrated robot")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--mic-uri", default=MIC_URI, help="where satellites find the microphone")
    parser.add_argument("--snd-uri", default=SND_URI, help="where satellites find the loudspeaker")
    parser.add_argument("--stop-for-speech", action="store_true", help="fall silent when the human begins to speak")
    args = parser.parse_args(words)
    try:
        service = EgoService(
            args.microphone,
            args.loudspeaker,
            EgoFilter(args.profile, args.engine, DEFAULT_MS),
            AudioFormat(args.mic_rate, 2, args.mic_channels),
            AudioFormat(args.snd_rate, 2, args.snd_channels),
            args.stop_for_speech,
        )
        asyncio.run(service.run(args.mic_uri, args.snd_uri))
    except KeyboardInterrupt:
        return 130
    except (EdgefilterError, OSError, ValueError) as error:
        print(f"edgefilter: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
