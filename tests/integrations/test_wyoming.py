"""Against the real Wyoming: its servers and clients over TCP, as a satellite uses them."""

import asyncio
import contextlib
import json
import random
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from wyoming.asr import Transcribe, Transcript
from wyoming.audio import AudioChunk, AudioFormat, AudioStart, AudioStop
from wyoming.client import AsyncClient
from wyoming.error import Error
from wyoming.event import Event as Message
from wyoming.info import AsrProgram, Attribution, Describe, Info
from wyoming.server import AsyncEventHandler, AsyncServer
from wyoming.snd import Played

from edgefilter import EgoFilter
from edgefilter.integrations import wyoming as module
from edgefilter.integrations.duplex import as_pcm16, from_pcm16
from edgefilter.integrations.wyoming import EgoService, Player, main
from edgefilter.types import SAMPLE_RATE as RATE

NOISE = 0.1 * np.random.default_rng(0).standard_normal(RATE).astype(np.float32)
NOBODY = "tcp://127.0.0.1:9"
"""Where no service is: the port of the discard protocol, which nobody runs."""
MONO = AudioFormat(RATE, 2, 1)


def free_port(count=1):
    """The first of count ports in a row that nobody uses now, below those that the system gives to clients meanwhile."""
    while True:
        first = random.randrange(20_000, 32_000)
        with contextlib.ExitStack() as held, contextlib.suppress(OSError):
            for port in range(first, first + count):
                held.enter_context(socket.socket()).bind(("127.0.0.1", port))
            return first


def noise(samples=NOISE):
    return AudioChunk(RATE, 2, 1, as_pcm16(samples)).event()


@pytest.fixture
def endless_noise(tmp_path):
    """A command that is a microphone: a second of stereo noise, again and again, at the real pace."""
    (tmp_path / "noise.raw").write_bytes(as_pcm16(NOISE, 2))
    code = (
        f"import sys, time; data = open({str(tmp_path / 'noise.raw')!r}, 'rb').read()\n"
        "while True:\n"
        " for at in range(0, len(data), 4096): sys.stdout.buffer.write(data[at:at+4096]); sys.stdout.flush();"
        " time.sleep(0.03)"
    )
    return f'{sys.executable} -c "{code}"'


@pytest.fixture
def player(tmp_path):
    """A command that is a loudspeaker: keeps the first 20000 bytes that it gets."""
    return f"{sys.executable} -c \"import sys; open('{tmp_path}/played', 'wb').write(sys.stdin.buffer.read(20000))\""


async def until(happens):
    for _ in range(200):
        if happens():
            return
        await asyncio.sleep(0.05)
    raise AssertionError("it does not happen")


async def client_of(uri):
    for _ in range(200):
        try:
            client = AsyncClient.from_uri(uri)
            await client.connect()
            return client
        except OSError:
            await asyncio.sleep(0.05)
    raise AssertionError("the service does not start")


@contextlib.asynccontextmanager
async def at_work(service, *uris):
    serving = asyncio.create_task(service.run(*uris))
    try:
        yield
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


@contextlib.asynccontextmanager
async def running(microphone, loudspeaker):
    """A service at work, a function that connects a client to its microphone or loudspeaker, and their ports."""
    service = EgoService(microphone, loudspeaker, EgoFilter(engine="linear"), AudioFormat(RATE, 2, 2), MONO)
    ports = {end: free_port() for end in ("microphone", "loudspeaker")}
    uris = {end: f"tcp://127.0.0.1:{port}" for end, port in ports.items()}
    async with at_work(service, *uris.values()):
        yield service, lambda end: client_of(uris[end]), ports


def logged(caplog):
    """Warnings and errors, but for the filter's (it detects no speech, the machine may be too slow, two channels) and asyncio's own."""
    told = [record.getMessage() for record in caplog.records if record.levelname in ("WARNING", "ERROR")]
    # the last words: of a process that an earlier test has ended
    others = "detects no speech", "too slow", "averaged", "that handles pid"
    return [line for line in told if not any(words in line for words in others)]


@pytest.mark.slow
async def test_a_satellite_is_interrupted_and_its_reference_is_what_was_played(example, ego, check_conversation):
    log, room, _ = await example("agent_wyoming").converse(ego, port=free_port(4))
    check_conversation(room, ego, 3.2)
    assert [what.split(":")[0] for _, what in log] == ["the human speaks", "the robot is silent", "the human said"]


async def test_commands_are_microphone_and_loudspeaker_and_who_hangs_up_interrupts(endless_noise, player, tmp_path):
    """One satellite says all it has and waits until it was played; another disconnects in mid-word."""
    async with running(endless_noise, player) as (service, connect, ports):
        listener, speaker = await connect("microphone"), await connect("loudspeaker")
        chunk = AudioChunk.from_event(await listener.read_event())
        assert (chunk.rate, chunk.width, chunk.channels) == (RATE, 2, 1) and from_pcm16(chunk.audio).any()
        await listener.write_event(Describe().event())
        kinds = [(await listener.read_event()).type for _ in range(30)]
        assert kinds.count("info") == 1 and kinds[-1] == "audio-chunk"  # whoever has asked hears on
        await speaker.write_event(Describe().event())
        assert Info.from_event(await speaker.read_event()).snd[0].snd_format == MONO
        await speaker.write_event(AudioStart(RATE, 2, 1).event())
        await speaker.write_event(noise())
        await speaker.write_event(AudioStop().event())
        assert Played.is_type((await speaker.read_event()).type)
        await asyncio.sleep(0.1)
        assert service.duplex.stats()["unheard_s"] == 0.0  # the stamps, nanoseconds, were taken for lost sound
        played = service.duplex.stats()["played_s"]
        for _ in range(20):
            await speaker.write_event(noise())
        await until(lambda: service.duplex.stats()["played_s"] > played)
        await speaker.disconnect()
        await until(lambda: service.duplex.queued_s == 0 and service.duplex.stats()["dropped_s"] > 0)
        await until(lambda: not service.speakers)
        await listener.disconnect()
    np.testing.assert_array_equal(
        np.frombuffer((tmp_path / "played").read_bytes(), "<i2")[:10_000] / 32768, from_pcm16(as_pcm16(NOISE))[:10_000]
    )


async def test_the_rest_of_an_utterance_that_was_interrupted_is_not_played_and_its_end_is_answered(
    endless_noise, player
):
    async with running(endless_noise, player) as (service, connect, ports):
        speaker = await connect("loudspeaker")
        await speaker.write_event(noise())
        await until(lambda: service.duplex.stats()["played_s"] > 0.1)
        await service.interrupt()
        handed_over = sum(service.duplex.stats()[f"{what}_s"] for what in ("played", "dropped"))
        await speaker.write_event(noise())
        await speaker.write_event(AudioStop().event())
        assert Played.is_type((await speaker.read_event()).type)
        assert service.duplex.queued_s == 0
        assert sum(service.duplex.stats()[f"{what}_s"] for what in ("played", "dropped")) == handed_over
        played = service.duplex.stats()["played_s"]
        await speaker.write_event(noise())  # the next utterance, though nothing says that it begins
        await until(lambda: service.duplex.stats()["played_s"] > played)
        await speaker.disconnect()


BROKEN = {
    "cut in mid-sample": Message("audio-chunk", {"rate": RATE, "width": 2, "channels": 1}, b"abc"),
    "no width": Message("audio-chunk", {"rate": RATE, "channels": 1}, b"abcd"),
    "no channels at all": Message("audio-chunk", {"rate": RATE, "width": 2, "channels": 0}, b"abcd"),
    "a rate that controls the log": Message(
        "audio-chunk", {"rate": "\x1b[2J\nfast", "width": 2, "channels": 1}, b"abcd"
    ),
    "a rate that no sound has": Message("audio-chunk", {"rate": 1, "width": 2, "channels": 1}, b"abcd"),
}


async def test_who_sends_a_broken_chunk_is_disconnected_in_one_line_and_others_go_on(endless_noise, player, caplog):
    async with running(endless_noise, player) as (service, connect, _):
        other, listener = await connect("loudspeaker"), await connect("microphone")
        for name, broken in BROKEN.items():
            one = await connect("loudspeaker")
            await one.write_event(broken)
            assert await one.read_event() is None, f"{name}: the connection is closed"
        await other.write_event(noise(NOISE[:1600]))
        await other.write_event(AudioStop().event())
        assert Played.is_type((await other.read_event()).type)
        assert AudioChunk.is_type((await listener.read_event()).type)
        await until(lambda: len(service.speakers) == 1)
    told = logged(caplog)
    assert len(told) == len(BROKEN)
    for line, name in zip(told, BROKEN, strict=True):
        assert "expected" in line and "connection is closed" in line and line.isprintable(), line
        assert ("\\x1b[2J" in line) is ("controls" in name)


async def test_a_message_that_claims_too_much_is_refused_before_it_is_read(endless_noise, player, caplog):
    """More than the ten minutes of 16-bit sound that may wait, and data that take long to read."""
    too_much = ("payload_length", 19_200_001), ("data_length", 19_200_001), ("data_length", 65_537)
    claims = [(end, *claim) for end in ("microphone", "loudspeaker") for claim in too_much]
    async with running(endless_noise, player) as (_, connect, ports):
        for end, what, claimed in claims:
            await (await connect(end)).disconnect()  # the service has started
            reader, writer = await asyncio.open_connection("127.0.0.1", ports[end])
            writer.write(json.dumps({"type": "audio-chunk", what: claimed}).encode() + b"\n" + b"[" * 500_000)
            with contextlib.suppress(ConnectionError):
                while await asyncio.wait_for(reader.read(65536), 5):  # what the microphone has said meanwhile
                    pass
        listener = await connect("microphone")
        assert AudioChunk.is_type((await listener.read_event()).type), "others go on"
    told = logged(caplog)
    for line, (_, what, claimed) in zip(told, claims, strict=True):
        assert f"{claimed} bytes" in line and "connection is closed" in line
        assert what == "payload_length" or "bytes of data, expected at most 65536" in line


async def test_a_client_that_speaks_another_language_is_disconnected(endless_noise, player, caplog):
    async with running(endless_noise, player) as (service, connect, ports):
        await (await connect("loudspeaker")).disconnect()
        for line in (b"GET / HTTP/1.1\n", b"[]\n", b"{}\n", b'{"type": "audio-chunk", "data_length": "a"}\n'):
            reader, writer = await asyncio.open_connection("127.0.0.1", ports["loudspeaker"])
            writer.write(line)
            assert await asyncio.wait_for(reader.read(), 5) == b""
        await until(lambda: not service.speakers)
    assert not [record for record in caplog.records if record.exc_info], "no traceback"
    told = logged(caplog)
    assert len(told) == 4 and all("connection is closed" in line for line in told), told


class BrokenMicrophone(AsyncEventHandler):
    """Sends one sound of four bytes that are no two samples, then, when it is opened again, noise."""

    opened = 0

    def __init__(self, broken, reader, writer):
        super().__init__(reader, writer)
        BrokenMicrophone.opened += 1
        first = broken if BrokenMicrophone.opened == 1 else noise()
        self.task = asyncio.create_task(self.write_event(first))

    async def handle_event(self, event):
        return True


@pytest.mark.parametrize("broken", BROKEN.values(), ids=BROKEN)
async def test_a_microphone_that_sends_a_broken_chunk_is_opened_again(broken, player, caplog):
    port = free_port()
    BrokenMicrophone.opened = 0
    microphone = AsyncServer.from_uri(f"tcp://127.0.0.1:{port}")
    await microphone.start(partial(BrokenMicrophone, broken))
    async with running(f"tcp://127.0.0.1:{port}", player) as (_, connect, _ports):
        listener = await connect("microphone")
        assert AudioChunk.is_type((await listener.read_event()).type)
    await microphone.stop()
    assert "cannot be read" in caplog.text and "expected" in caplog.text


@pytest.mark.slow
async def test_the_loopback_of_the_device_is_the_reference_where_it_is_named(talking, player, tmp_path):
    """As a command records it: three channels, the first of which is what is played. It is silent until somebody listens, and afterwards."""
    profile, sound = talking
    (tmp_path / "six.raw").write_bytes(np.rint(sound * 32768).astype("<i2").tobytes())
    begin = tmp_path / "begin"
    code = (
        f"import os, sys, time; data = open({str(tmp_path / 'six.raw')!r}, 'rb').read(); write = sys.stdout.buffer.write\n"
        "def say(part): write(part); sys.stdout.flush(); time.sleep(0.01)\n"
        f"while not os.path.exists({str(begin)!r}): say(bytes(1920))\n"
        "for at in range(0, len(data), 1920): say(data[at:at+1920])\n"
        "while True: say(bytes(1920))"
    )
    ports = [f"tcp://127.0.0.1:{free_port(2) + at}" for at in range(2)]
    heard, ego = [], EgoFilter(profile, engine="linear")
    microphone = f'{sys.executable} -c "{code}"'
    form = AudioFormat(RATE, 2, 3)
    service = EgoService(microphone, player, ego, form, mic_channels=[1, 2], reference_channel=0)
    async with at_work(service, *ports):
        client = await client_of(ports[0])
        while sum(map(len, heard)) < 2.2 * RATE:
            message = await client.read_event()
            if AudioChunk.is_type(message.type):
                if begin.exists():
                    heard.append(from_pcm16(AudioChunk.from_event(message).audio))
                begin.touch()
        await client.disconnect()
    out, part = np.concatenate(heard), slice(RATE, 2 * RATE)
    assert np.mean(out[part] ** 2) < 0.01 * np.mean(sound[part, 1] ** 2)
    assert ego.stats()["array"]["microphones"] == 2


COMMANDS = "--microphone true --loudspeaker true --engine linear"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "--mic-command-channels 3 --reference-channel 2",
            "reference_channel is 2, expected mic_channels that name the others",
        ),
        ("--mic-command-channels 3 --mic-channels 0,1 --reference-channel 1", "beside mic_channels [0, 1]"),
        ("--mic-command-channels 3 --mic-channels 0 --reference-channel 6", "3 channels, 0 to 2, found channel 6"),
        ("--mic-channels 1", "channel 0 alone, found channel 1"),  # mono unless it says otherwise
        ("--profile missing.npz", "missing.npz"),
        *(
            case
            for option in ("--mic-uri", "--snd-uri", "--asr-uri")
            for case in (
                (f"{option} tcp://0.0.0.0:10600", f"{option} tcp://0.0.0.0:10600 lets other machines listen"),
                # let in, the next thing that is wrong is said
                (f"{option} tcp://0.0.0.0:10600 --open --mic-channels 5", "found channel 5 asked for"),
            )
        ),
    ],
)
def test_what_cannot_be_served_is_one_line(words, said, capsys):
    assert main(f"{COMMANDS} {words}".split()) == 1
    told = capsys.readouterr().err
    assert told.startswith("edgefilter: ") and said in told and told.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("stop", [signal.SIGTERM, signal.SIGINT], ids=["sigterm", "ctrl-c"])
@pytest.mark.parametrize("floods", [False, True], ids=["in real time", "floods"])
async def test_one_signal_ends_it_with_its_commands(endless_noise, player, floods, stop):
    """A pipe that was full kept it waiting for its end."""
    ports = free_port(2)
    mic_uri, snd_uri = (f"tcp://127.0.0.1:{ports + i}" for i in range(2))
    words = ["--microphone", "cat /dev/zero" if floods else endless_noise, "--loudspeaker", player]
    words += (
        f"--mic-command-channels 2 --mic-channels 0 --engine linear --mic-uri {mic_uri} --snd-uri {snd_uri}".split()
    )
    service = subprocess.Popen(
        [sys.executable, "-m", "edgefilter.integrations.wyoming", *words],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell has its background jobs ignore it
    )
    try:
        await client_of(snd_uri)
        assert AudioChunk.is_type((await (await client_of(mic_uri)).read_event()).type)
        commands = Path(f"/proc/{service.pid}/task/{service.pid}/children").read_text().split()
        assert commands, "the microphone's command runs"
        service.send_signal(stop)
        assert service.wait(10) == 128 + stop and service.stderr.read() == ""
        assert not [command for command in commands if Path(f"/proc/{command}").exists()]
    finally:
        service.kill()


async def test_a_loudspeaker_that_is_not_there_silences_nothing_else(caplog):
    service = EgoService("true", NOBODY, EgoFilter(engine="linear"))
    await service.say(AudioChunk(RATE, 2, 1, as_pcm16(NOISE)))
    assert "cannot be reached" in caplog.text and service.duplex.queued_s == 0


def test_what_the_loudspeaker_gets_is_lowered_where_the_filter_asks_for_it_and_so_is_the_reference(monkeypatch):
    monkeypatch.setattr(EgoFilter, "voice_gain", 0.25)
    service, sent, played = EgoService("true", NOBODY, EgoFilter(engine="linear")), [], []

    async def write(chunk):
        sent.append(from_pcm16(chunk.audio))

    monkeypatch.setattr(service.player, "write", write)
    monkeypatch.setattr(service.duplex, "play_pcm16", lambda pcm, rate, channels: played.append(from_pcm16(pcm)))
    asyncio.run(service.say(AudioChunk(RATE, 2, 1, as_pcm16(NOISE))))
    np.testing.assert_allclose(sent[0][160:], 0.25 * NOISE[160:], atol=1e-4)  # it fades for 10 ms
    np.testing.assert_array_equal(played, sent)


async def test_stereo_speech_on_a_mono_loudspeaker_is_the_mean_of_its_channels_and_not_clipped(player, tmp_path):
    loud, both = np.full(10_000, 0.8, np.float32), np.tile(np.float32([0.9, 0.7]), 10_000)
    mono = Player(player, MONO)
    await mono.write(AudioChunk(RATE, 2, 2, as_pcm16(both)))
    await until(lambda: (tmp_path / "played").exists() and (tmp_path / "played").stat().st_size == 20_000)
    await mono.stop()
    np.testing.assert_array_equal(from_pcm16((tmp_path / "played").read_bytes()), from_pcm16(as_pcm16(loud)))


async def test_a_loudspeaker_that_is_stopped_drops_what_it_has_and_can_be_used_again(tmp_path):
    started = tmp_path / "started"
    player = Player(f"{sys.executable} -c \"import time; open('{started}', 'a').write('x'); time.sleep(60)\"", MONO)
    for starts in ("x", "xx"):
        await player.write(AudioChunk(RATE, 2, 1, as_pcm16(NOISE[:100])))
        await until(lambda starts=starts: started.exists() and started.read_text() == starts)
        began = time.monotonic()
        await player.stop()
        assert time.monotonic() - began < 5


class Recogniser(AsyncEventHandler):
    """Answers each utterance with its language, and keeps it."""

    heard = []

    async def handle_event(self, event):
        if Describe.is_type(event.type):
            about = {"attribution": Attribution("", ""), "installed": True, "description": "", "version": ""}
            await self.write_event(Info(asr=[AsrProgram(name="words", models=[], **about)]).event())
        elif Transcribe.is_type(event.type):
            self.language = Transcribe.from_event(event).language
        elif AudioChunk.is_type(event.type):
            Recogniser.heard.append(AudioChunk.from_event(event))
        elif AudioStop.is_type(event.type):
            await self.write_event(Transcript(f"words in {self.language}").event())
        return True


class Microphones(AsyncEventHandler):
    """Three channels as fast as they are read, and then silence at that pace."""

    def __init__(self, sound, reader, writer):
        super().__init__(reader, writer)
        self.sound, self.task = sound, asyncio.create_task(self.listen())

    async def handle_event(self, event):
        return True

    async def listen(self):
        pcm = np.rint(self.sound * 32768).astype("<i2")
        with contextlib.suppress(ConnectionError):
            for at in range(0, len(pcm) - 319, 320):
                await self.write_event(AudioChunk(RATE, 2, 3, pcm[at : at + 320].tobytes()).event())
                await asyncio.sleep(0.002)
            await asyncio.sleep(60)


async def test_whoever_has_the_microphone_recognised_gets_the_words_of_the_finished_turn(pair, tmp_path):
    """As Home Assistant does: its satellite's sound comes back to the recogniser, here cut and at another rate."""
    profile, sound = pair
    Recogniser.heard, turns = [], []
    ports = [f"tcp://127.0.0.1:{free_port(5) + at}" for at in range(5)]
    recogniser, microphones = AsyncServer.from_uri(ports[3]), AsyncServer.from_uri(ports[4])
    await recogniser.start(Recogniser)
    await microphones.start(partial(Microphones, sound))
    ego = EgoFilter(profile, engine="crnn")
    service = EgoService(ports[4], "true", ego, mic_channels=[1, 2], recogniser=ports[3])
    service.duplex.listeners.append(lambda event: turns.append(event.turn) if event.turn else None)
    async with at_work(service, *ports[:3]):
        client = await client_of(ports[2])
        await client.write_event(Describe().event())
        assert Info.from_event(await client.read_event()).asr[0].name == "words"
        await client.write_event(Transcribe(language="en").event())
        await client.write_event(AudioStart(RATE, 2, 1).event())
        await client.write_event(noise(NOISE[:1600]))
        await until(lambda: turns)
        await client.write_event(AudioStop().event())
        assert Transcript.from_event(await client.read_event()).text == "words in en"
        assert service.duplex.ego.stats()["array"]["microphones"] == 2
        await recogniser.stop()
        await client.write_event(AudioStart(RATE, 2, 1).event())
        await client.write_event(AudioStop().event())
        assert "cannot be reached" in Error.from_event(await client.read_event()).text
        await client.disconnect()
    await microphones.stop()
    (chunk,) = Recogniser.heard
    assert (chunk.rate, chunk.channels) == (RATE, 1)
    said = from_pcm16(chunk.audio)
    np.testing.assert_array_equal(said, from_pcm16(as_pcm16(turns[0].samples))[-said.size :])
    assert said.size > RATE


async def test_messages_without_sound_are_read_no_further_where_many_wait(endless_noise, player, monkeypatch):
    monkeypatch.setattr(module, "MOST_BYTES", 80 * module.OVERHEAD)
    async with running(endless_noise, player) as (service, connect, ports):
        speaker = await connect("loudspeaker")
        await speaker.write_event(noise())
        for _ in range(5000):
            await speaker.write_event(AudioStop().event())
        (waiting,), most = service.speakers, 0
        for _ in range(100):
            await asyncio.sleep(0.01)
            most = max(most, waiting._said.qsize())
        assert 10 < most <= 81
        await speaker.disconnect()


@pytest.mark.parametrize("end", ["microphone", "loudspeaker"])
async def test_more_clients_than_may_connect_are_let_go_in_one_line_and_others_go_on(
    end, endless_noise, player, caplog
):
    async with running(endless_noise, player) as (_, connect, ports):
        there = [await connect(end) for _ in range(module.MOST_CLIENTS)]
        for each in there:  # all of them are in
            await each.write_event(Describe().event())
            while (await each.read_event()).type != "info":
                pass
        more = await connect(end)
        while await more.read_event() is not None:
            pass
        await there[0].disconnect()
        await asyncio.sleep(0.2)
        again = await connect(end)
        await again.write_event(Describe().event())
        while (await again.read_event()).type != "info":
            pass
    (line,) = logged(caplog)
    assert "8 clients are connected already" in line
