r"""Wyoming: microphone and loudspeaker of a Home Assistant satellite, with the robot's voice removed from the microphone.

    python -m edgefilter.integrations.wyoming --microphone 'arecord -q -r 16000 -c 1 -f S16_LE -t raw' \
        --loudspeaker 'aplay -q -r 22050 -c 1 -f S16_LE -t raw' --profile robot.npz
    wyoming-satellite --mic-uri tcp://127.0.0.1:10600 --snd-uri tcp://127.0.0.1:10601 ...

Needs `pip install '.[wyoming]'` in a checkout. With `--recogniser tcp://...` it stands before a recogniser, too, and gives it
the human's finished turns.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import shlex
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Coroutine, Iterator, Sequence
from functools import partial
from typing import Any, cast
from urllib.parse import urlsplit

import numpy as np
from wyoming.asr import Transcribe, Transcript
from wyoming.audio import AudioChunk, AudioChunkConverter, AudioFormat, AudioStart, AudioStop
from wyoming.client import AsyncClient
from wyoming.error import Error
from wyoming.event import Event as Message
from wyoming.info import Attribution, Describe, Info, MicProgram, SndProgram
from wyoming.mic import MicProcessAsyncClient
from wyoming.server import AsyncEventHandler, AsyncServer
from wyoming.snd import Played
from wyoming.vad import VoiceStarted, VoiceStopped

from edgefilter import __version__
from edgefilter.audio.channels import Channels
from edgefilter.dsp.resample import RATES
from edgefilter.errors import EdgefilterError, SignalError, UsageError, printable
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.turns import BEFORE_S
from edgefilter.integrations.doors import complain_briefly, is_own
from edgefilter.integrations.duplex import MOST_QUEUED_S, Duplex, as_pcm16, from_pcm16
from edgefilter.integrations.turns import TurnByTurn
from edgefilter.options import ASK, CONFIRM, ENGINE, FALSE_STARTS, MIC_CHANNELS, channel
from edgefilter.types import SAMPLE_RATE, Event

MOST_BYTES = round(MOST_QUEUED_S * SAMPLE_RATE) * np.int16().itemsize
"""Size of a message, and of all that a client has said and waits to be played: the queue's ten minutes, 19 MB."""
RETRY_S = 1.0
"""Between two attempts to reach the microphone."""
MOST_DATA, OVERHEAD, MOST_CLIENTS = 1 << 16, 512, 8
"""Limits that keep a client from filling the memory: bytes of a message's description of its sound, as many as its first
line may have; bytes of memory that each message costs beside its sound; clients that may be connected at once."""
AHEAD_S = 0.5
"""Speech that the loudspeaker gets before its turn: the size of aplay's buffer. The rest is still here when it is dropped."""
UNDER_WAY_S = BargeInSettings.min_silence_s + BEFORE_S
"""For how long a recogniser that is told that the human has ended waits for the filter's word, which takes the pause, and
the sound's way to the filter."""
MIC_URI, SND_URI, ASR_URI = "tcp://127.0.0.1:10600", "tcp://127.0.0.1:10601", "tcp://127.0.0.1:10602"
ABOUT: dict[str, Any] = {
    "attribution": Attribution("edgefilter", url=""),
    "installed": True,
    "description": "A microphone without the robot's own voice",
    "version": __version__,
}
_LOGGER = logging.getLogger(__name__)


class EgoService:
    """Two Wyoming services over one filter: a microphone for many listeners, and a loudspeaker.

    microphone, loudspeaker: source and destination of the sound, a command that writes or reads raw 16-bit samples, or
    the URI of another Wyoming service (`tcp://...`, `unix://...`). ego, mic_channels, reference_channel: as of
    `edgefilter.integrations.duplex.Duplex`, channels of the microphone. mic_format, snd_format: of the commands' sound,
    of width 2. stop_for_speech: whether the loudspeaker is silenced when the human begins to speak; the protocol has no
    message by which a satellite could do it. recogniser: URI of a Wyoming service that makes text of speech. A third
    service stands before it then: whoever has the microphone's sound recognised there, as Home Assistant does, gets the
    words of the human's finished turn.

    The microphone is filtered whether somebody listens or not, so that the filter knows the room. Listeners also get
    `voice-started` and `voice-stopped` of the human. A client that disconnects from the loudspeaker before its
    `audio-stop` interrupts: speech that is not played yet is dropped. A client that sends a message that cannot be read
    is disconnected, with a line in the log.
    """

    def __init__(
        self,
        microphone: str,
        loudspeaker: str,
        ego: EgoFilter | None = None,
        mic_format: AudioFormat = AudioFormat(16_000, 2, 1),
        snd_format: AudioFormat = AudioFormat(22_050, 2, 1),
        stop_for_speech: bool = False,
        mic_channels: Sequence[int] | Channels | None = None,
        recogniser: str | None = None,
        reference_channel: int | None = None,
    ) -> None:
        there = None if "://" in microphone else mic_format.channels
        array = Channels.named(mic_channels, reference_channel, there)
        self._events: list[Event] = []
        self.duplex = Duplex(ego, on_event=self._events.append, mic_channels=array)
        self.recogniser, self.mic_format, self.player = recogniser, mic_format, Player(loudspeaker, snd_format)
        self._microphone, self._stop_for_speech = microphone, stop_for_speech
        self.listeners: set[_Listener] = set()
        self.speakers: set[_Speaker] = set()
        self.clients: defaultdict[type[_Client], set[_Client]] = defaultdict(set)

    async def run(self, mic_uri: str = MIC_URI, snd_uri: str = SND_URI, asr_uri: str = ASR_URI) -> None:
        """Serve all until cancelled."""
        complain_briefly()
        uris = [mic_uri, snd_uri, *([asr_uri] if self.recogniser else ())]
        servers = [AsyncServer.from_uri(uri) for uri in uris]
        handlers: tuple[Callable[..., AsyncEventHandler], ...] = (_Listener, _Speaker, _Recogniser)
        try:
            for server, handler in zip(servers, handlers):
                await server.start(partial(handler, self))  # its run() would take SIGTERM for itself alone
            await self._listen()
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
        form = chunk.rate, chunk.width, chunk.channels
        chunk = AudioChunk(*form, bytes(self.duplex.lowered_pcm16(chunk.audio, chunk.rate, chunk.channels)))
        self.duplex.play_pcm16(chunk.audio, chunk.rate, chunk.channels)
        try:
            await self.player.write(chunk)
        except OSError as error:
            _LOGGER.warning("loudspeaker %s cannot be reached (%s): nothing is heard of this", self.player.where, error)
            await self.interrupt()

    async def finish(self) -> None:
        """End the utterance; returns when it has been played."""
        self.duplex.end()
        await self.player.end()
        await asyncio.sleep(self.duplex.queued_s)

    async def interrupt(self) -> None:
        """Silence the loudspeaker, and drop the speech of all speakers that was not played yet."""
        for speaker in self.speakers:
            speaker.drop()
        self.duplex.interrupt()
        await self.player.stop()

    async def _listen(self) -> None:
        """Read the microphone for ever; one that ends or fails is opened again."""
        while True:
            try:
                async with self._microphone_client() as client:
                    if client._reader is not None:
                        client._reader = _BoundedReader(client._reader)
                    while (message := await client.read_event()) is not None:
                        if AudioChunk.is_type(message.type):
                            await self._hear(_chunk_of(message))
                why = "ended"
            except Exception as error:  # another service's messages must not end this one
                why = printable(f"cannot be read ({type(error).__name__}: {error})")
            _LOGGER.warning("microphone %s %s: again in %.0f s", self._microphone, why, RETRY_S)
            await asyncio.sleep(RETRY_S)

    def _microphone_client(self) -> AsyncClient:
        """A client of the command, which is read by the hop, or of the service at a URI."""
        if "://" in self._microphone:
            return AsyncClient.from_uri(self._microphone)
        form, (program, *words) = self.mic_format, shlex.split(self._microphone)
        samples = self.duplex.ego.hop * form.rate // SAMPLE_RATE
        return _Command(form.rate, 2, form.channels, samples, program, words)

    async def _hear(self, chunk: AudioChunk) -> None:
        # senders stamp chunks with when they read them, some in nanoseconds: that tells no more than when they came
        human = await asyncio.to_thread(self.duplex.hear_pcm16, chunk.audio, chunk.rate, chunk.channels, 1)
        if human:
            self._tell(AudioChunk(chunk.rate, 2, 1, human, chunk.timestamp).event())
        while self._events:
            event = self._events.pop(0)
            if event.kind == "speech_started":
                self._tell(VoiceStarted(chunk.timestamp).event())
                if self._stop_for_speech:
                    await self.interrupt()
            elif event.kind == "speech_stopped":
                self._tell(VoiceStopped(chunk.timestamp).event())
            elif event.kind == "overloaded":
                _LOGGER.warning("the machine is too slow: %s", event.detail)

    def _tell(self, message: Message) -> None:
        for listener in self.listeners:
            listener.send(message)


class _Command(MicProcessAsyncClient):
    """The microphone's command."""

    _proc: asyncio.subprocess.Process | None

    async def disconnect(self) -> None:
        process, self._proc = self._proc, None
        assert process is not None
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.communicate()  # wait() alone would block for ever where the pipe of its output is full


class _BoundedReader:
    """A stream's reader that refuses messages of more than MOST_BYTES before it reads them."""

    def __init__(self, reader: asyncio.StreamReader) -> None:
        self._reader, self.feed_eof, self.at_eof = reader, reader.feed_eof, reader.at_eof

    async def readline(self) -> bytes:
        line = await self._reader.readline()
        with contextlib.suppress(ValueError, AttributeError):  # the caller parses it again and reports the error
            size = json.loads(line).get("data_length")
            if (
                isinstance(size, int | float) and size > MOST_DATA
            ):  # of JSON, which takes time and twenty times the memory
                raise SignalError(f"found a message with {size} bytes of data, expected at most {MOST_DATA}")
        return line

    async def readexactly(self, count: int) -> bytes:
        if count > MOST_BYTES:
            raise SignalError(f"found a message of {count} bytes, expected at most {MOST_BYTES}")
        return await self._reader.readexactly(count)


class _Client(AsyncEventHandler):
    """A client that is disconnected, and no other, where a message cannot be read."""

    def __init__(self, service: EgoService, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(cast(asyncio.StreamReader, _BoundedReader(reader)), writer)
        self._service = service

    async def run(self) -> None:
        clients = self._service.clients[type(self)]
        try:
            if len(clients) >= MOST_CLIENTS:
                raise SignalError(f"{MOST_CLIENTS} clients are connected already, expected fewer")
            clients.add(self)
            await super().run()
            if not self.reader.at_eof():
                raise SignalError("found what is no message, expected one in JSON")
        except (ConnectionError, EOFError):
            pass  # it has gone
        except Exception as error:
            peer = self.writer.get_extra_info("peername")
            said = printable(f"{type(error).__name__}: {error}")
            _LOGGER.warning("client %s: %s; its connection is closed", peer, said)
        finally:
            if self not in clients:
                await self.disconnect()
                self.writer.close()
            clients.discard(self)


class _Listener(_Client):
    """A client of the microphone; one that is more than 4 s of hops behind misses the oldest."""

    def __init__(self, service: EgoService, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(service, reader, writer)
        self._waiting: asyncio.Queue[Message] = asyncio.Queue(256)
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
        with contextlib.suppress(ConnectionError):  # it has gone; run() notices as well and disconnects
            while True:
                await self.write_event(await self._waiting.get())

    async def disconnect(self) -> None:
        self._service.listeners.discard(self)
        self._task.cancel()


class _Speaker(_Client):
    """A client of the loudspeaker; its speech waits here, so that its hanging up is noticed in time."""

    def __init__(self, service: EgoService, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(service, reader, writer)
        self._said: asyncio.Queue[AudioChunk | AudioStop | None] = asyncio.Queue()
        self._waiting_bytes = 0
        self._speaking = self._ignored = False
        self._task = asyncio.create_task(self._speak())
        service.speakers.add(self)

    def drop(self) -> None:
        """Forget the speech that waits, and the rest of this utterance; its end is still answered."""
        self._ignored = self._speaking
        waiting = [self._said.get_nowait() for _ in range(self._said.qsize())]
        self._waiting_bytes = 0
        for message in waiting:
            if not isinstance(message, AudioChunk):
                self._put(message)

    def _put(self, message: AudioChunk | AudioStop | None) -> None:
        self._waiting_bytes += _size_of(message)
        self._said.put_nowait(message)

    async def handle_event(self, event: Message) -> bool:
        while self._waiting_bytes > MOST_BYTES:
            await asyncio.sleep(AHEAD_S)  # nothing more is read from the connection meanwhile: its sender has to wait
        if AudioStart.is_type(event.type):
            self._ignored = False
        elif AudioStop.is_type(event.type):
            self._speaking = False
            self._put(AudioStop())
        elif AudioChunk.is_type(event.type):
            chunk = _chunk_of(event)
            if not self._ignored:
                self._speaking = True
                for piece in _pieces(chunk):
                    self._put(piece)
        elif Describe.is_type(event.type):
            form = self._service.player.form
            await self.write_event(Info(snd=[SndProgram(name="edgefilter", snd_format=form, **ABOUT)]).event())
        return True

    async def _speak(self) -> None:
        try:
            while (message := await self._said.get()) is not None:
                self._waiting_bytes -= _size_of(message)
                if isinstance(message, AudioChunk):
                    await self._service.say(message)
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
            self._put(None)


class _Recogniser(_Client):
    """A client that asks for speech to text: in place of its own sound the recogniser gets the human's last turn, filtered."""

    def __init__(self, service: EgoService, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(service, reader, writer)
        self._turns = TurnByTurn(service.duplex)
        self._asked = Transcribe().event()

    async def handle_event(self, event: Message) -> bool:
        if Describe.is_type(event.type):
            await self._relay([event], Info.is_type)
        elif Transcribe.is_type(event.type):
            self._asked = event
        elif AudioStart.is_type(event.type):
            self._turns.start(self._service.duplex.heard - round(BEFORE_S * SAMPLE_RATE))
        elif AudioChunk.is_type(event.type):
            chunk = _chunk_of(event)
            self._turns.hear(from_pcm16(chunk.audio, chunk.channels), chunk.rate)
        elif AudioStop.is_type(event.type):
            await self._transcribe()
        return True

    async def _transcribe(self) -> None:
        until = time.monotonic() + UNDER_WAY_S
        while self._service.duplex.ego.human_speaks and time.monotonic() < until:
            await asyncio.sleep(0.005)
        samples, rate = await asyncio.to_thread(self._turns.take)
        sound = AudioChunk(rate, 2, 1, as_pcm16(samples)).event()
        await self._relay([self._asked, AudioStart(rate, 2, 1).event(), sound, AudioStop().event()], Transcript.is_type)

    async def _relay(self, messages: list[Message], last: Callable[[str], bool]) -> None:
        """Ask the recogniser and hand on what it answers, until the last of it, or that it cannot be reached."""
        where = str(self._service.recogniser)
        try:
            async with AsyncClient.from_uri(where) as client:
                for message in messages:
                    await client.write_event(message)
                while (answer := await client.read_event()) is not None:
                    await self.write_event(answer)
                    if last(answer.type) or Error.is_type(answer.type):
                        return
            why = "ended without an answer"
        except OSError as error:
            why = f"cannot be reached ({error})"
        _LOGGER.warning("recogniser %s %s", where, why)
        await self.write_event(Error(f"recogniser {where} {why}").event())

    async def disconnect(self) -> None:
        self._turns.close()


class Player:
    """Plays sound on a loudspeaker, through a command or to the service at a URI; when silenced it closes, and the next sound opens it again."""

    def __init__(self, where: str, form: AudioFormat) -> None:
        self.where, self.form = where, form
        self._convert = AudioChunkConverter(form.rate)
        self._client: AsyncClient | None = None
        self._process: asyncio.subprocess.Process | None = None

    async def write(self, chunk: AudioChunk) -> None:
        """Play a 16-bit chunk after what was written before; raises OSError where there is nothing to play it."""
        if "://" in self.where:
            if self._client is None:
                client = AsyncClient.from_uri(self.where)
                await client.connect()
                self._client = client
                await client.write_event(AudioStart(chunk.rate, chunk.width, chunk.channels).event())
            await self._client.write_event(chunk.event())
            return
        if self._process is None or self._process.returncode is not None:
            words = shlex.split(self.where)
            self._process = await asyncio.create_subprocess_exec(*words, stdin=asyncio.subprocess.PIPE)
        assert self._process.stdin is not None
        if chunk.channels != self.form.channels:
            pcm = as_pcm16(from_pcm16(chunk.audio, chunk.channels), self.form.channels)
            chunk = AudioChunk(chunk.rate, 2, self.form.channels, pcm)
        self._process.stdin.write(self._convert.convert(chunk).audio)
        await self._process.stdin.drain()

    async def end(self) -> None:
        """End the utterance: what was written is still played."""
        if self._client is not None:
            await self._client.write_event(AudioStop().event())
            await self._disconnect()

    async def stop(self) -> None:
        """Be silent now: what was written and is not played yet is dropped, as far as it is still here."""
        process, self._process = self._process, None
        if process is not None and process.returncode is None:
            process.kill()
            await process.wait()
        await self._disconnect()

    async def _disconnect(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            await client.disconnect()


def _pieces(chunk: AudioChunk) -> Iterator[AudioChunk]:
    """A chunk in parts of AHEAD_S: one of minutes would hold up the microphone while it is converted."""
    size = round(AHEAD_S * chunk.rate) * chunk.width * chunk.channels
    for at in range(0, len(chunk.audio), size):
        yield AudioChunk(chunk.rate, chunk.width, chunk.channels, chunk.audio[at : at + size])


def _size_of(message: AudioChunk | AudioStop | None) -> int:
    return OVERHEAD + (len(message.audio) if isinstance(message, AudioChunk) else 0)


def _chunk_of(message: Message) -> AudioChunk:
    """The sound in a message, converted to 16 bits; raises SignalError where rate, width or channels are missing, or it ends within a sample."""
    rate, width, channels = (cast(int, message.data.get(key)) for key in ("rate", "width", "channels"))
    size = len(message.payload or b"")
    whole = rate in RATES and width in (1, 2, 3, 4) and channels in range(1, size + 2)
    if not whole or size % (width * channels):
        raise SignalError(
            f"found a chunk of {size} bytes with rate {rate}, width {width} and channels {channels}, expected whole"
            f" samples with a rate of {RATES.start} to {RATES.stop - 1} Hz and a width of 1 to 4 bytes"
        )
    return AudioChunkConverter(width=2).convert(AudioChunk.from_event(message))


def main(words: list[str] | None = None) -> int:
    """Parse the command line and serve; one line and exit code 1 where that fails."""
    parser = argparse.ArgumentParser(
        prog="python -m edgefilter.integrations.wyoming", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--microphone", required=True, help="command that writes raw 16-bit samples, or a URI")
    parser.add_argument("--loudspeaker", required=True, help="command that reads raw 16-bit samples, or a URI")
    for end, rate in (("mic", 16_000), ("snd", 22_050)):
        parser.add_argument(f"--{end}-command-rate", type=int, default=rate, help="what the command's sound has")
        parser.add_argument(f"--{end}-command-channels", type=int, default=1, help="what the command's sound has")
    parser.add_argument("--mic-channels", **MIC_CHANNELS)
    told = "channel of the microphone, from 0, that holds what is played; goes with --mic-channels"
    parser.add_argument("--reference-channel", type=channel, metavar="N", help=told)
    parser.add_argument("--recogniser", help="URI of a service that makes text of speech: it gets finished turns")
    parser.add_argument("--profile", help="the calibrated robot")
    parser.add_argument("--engine", **ENGINE)
    parser.add_argument("--confirm-s", **CONFIRM)
    parser.add_argument("--false-starts-per-hour", **FALSE_STARTS)
    parser.add_argument("--ask-db", **ASK)
    parser.add_argument("--mic-uri", default=MIC_URI, help="where satellites find the microphone")
    parser.add_argument("--snd-uri", default=SND_URI, help="where satellites find the loudspeaker")
    parser.add_argument("--asr-uri", default=ASR_URI, help="where Home Assistant finds the recogniser")
    told = "let other machines connect: there is no password, so whoever reaches the ports can hear the microphone and play sound"
    parser.add_argument("--open", action="store_true", help=told)
    parser.add_argument("--stop-for-speech", action="store_true", help="fall silent when the human begins to speak")
    args = parser.parse_args(words)
    uris = args.mic_uri, args.snd_uri, args.asr_uri
    try:
        for option, uri in zip(("--mic-uri", "--snd-uri", "--asr-uri"), uris):
            host = urlsplit(uri).hostname
            if host is not None and not is_own(host) and not args.open:
                raise UsageError(
                    f"{option} {uri} lets other machines listen, and Wyoming knows no password: leave it out, or say --open"
                    " where every machine that reaches it may hear the microphone and speak"
                )
        settings = BargeInSettings(args.threshold, confirm_s=args.confirm_s, judge="network", ask_db=args.ask_db)
        ego = EgoFilter(args.profile, engine=args.engine, barge_in=settings)
        mic_format = AudioFormat(args.mic_command_rate, 2, args.mic_command_channels)
        snd_format = AudioFormat(args.snd_command_rate, 2, args.snd_command_channels)
        more = args.stop_for_speech, args.mic_channels, args.recogniser, args.reference_channel
        service = EgoService(args.microphone, args.loudspeaker, ego, mic_format, snd_format, *more)
        asyncio.run(_until_sigterm(service.run(*uris)))
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except asyncio.CancelledError:
        return 128 + signal.SIGTERM
    except (EdgefilterError, OSError, ValueError) as error:
        print(f"edgefilter: {printable(error)}", file=sys.stderr)
        return 1
    return 0


async def _until_sigterm(serving: Coroutine[None, None, None]) -> None:
    task = asyncio.current_task()
    assert task is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    await serving


if __name__ == "__main__":
    sys.exit(main())
