"""Against the real Wyoming: its servers and clients over TCP, as a satellite uses them."""

import asyncio
import socket
import sys

import numpy as np
import pytest
from wyoming.audio import AudioChunk, AudioFormat, AudioStart, AudioStop
from wyoming.client import AsyncClient
from wyoming.info import Describe, Info
from wyoming.snd import Played

from edgefilter import EgoFilter
from edgefilter.integrations.duplex import as_pcm16, from_pcm16
from edgefilter.integrations.wyoming import EgoService, main
from edgefilter.integrations.wyoming_sound import Player

RATE = 16_000
NOISE = 0.1 * np.random.default_rng(0).standard_normal(RATE).astype(np.float32)
NOBODY = "tcp://127.0.0.1:9"
"""Where no service is: the port of the discard protocol, which nobody runs."""


def free_port(count=1):
    """The first of count ports in a row that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return min(probe.getsockname()[1], 65_000 - count)


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


def test_a_satellite_is_interrupted_and_its_reference_is_what_was_played(example, ego, check_conversation):
    converse = example("agent_wyoming").converse
    log, room, _ = asyncio.run(asyncio.wait_for(converse(ego, port=free_port(4)), 120))
    check_conversation(room, ego, 3.2)
    assert [what.split(":")[0] for _, what in log] == ["the human speaks", "the robot is silent", "the human said"]


def test_commands_are_microphone_and_loudspeaker_and_who_hangs_up_interrupts(endless_noise, tmp_path):
    """One satellite says all it has and waits until it was played; another disconnects in mid-word."""
    player = f"{sys.executable} -c \"import sys; open('{tmp_path}/played', 'wb').write(sys.stdin.buffer.read(20000))\""
    mic_uri, snd_uri = (f"tcp://127.0.0.1:{free_port()}" for _ in range(2))
    ego, form = EgoFilter(engine="linear"), AudioFormat(RATE, 2, 1)
    service = EgoService(endless_noise, player, ego, AudioFormat(RATE, 2, 2), form)

    async def client_of(uri):
        for _ in range(200):
            try:
                client = AsyncClient.from_uri(uri)
                await client.connect()
                return client
            except OSError:
                await asyncio.sleep(0.05)
        raise AssertionError("the service does not start")

    async def until(happens):
        for _ in range(200):
            if happens():
                return
            await asyncio.sleep(0.05)
        raise AssertionError("it does not happen")

    async def talk():
        serving = asyncio.create_task(service.run(mic_uri, snd_uri))
        listener, speaker = await client_of(mic_uri), await client_of(snd_uri)
        chunk = AudioChunk.from_event(await listener.read_event())
        assert (chunk.rate, chunk.width, chunk.channels) == (RATE, 2, 1) and from_pcm16(chunk.audio).any()
        await speaker.write_event(Describe().event())
        assert Info.from_event(await speaker.read_event()).snd[0].snd_format == form
        await speaker.write_event(AudioStart(RATE, 2, 1).event())
        await speaker.write_event(AudioChunk(RATE, 2, 1, as_pcm16(NOISE)).event())
        await speaker.write_event(AudioStop().event())
        assert Played.is_type((await speaker.read_event()).type)
        await asyncio.sleep(0.1)
        played = service.duplex.stats()["played_s"]
        for _ in range(20):
            await speaker.write_event(AudioChunk(RATE, 2, 1, as_pcm16(NOISE)).event())
        await until(lambda: service.duplex.stats()["played_s"] > played)
        await speaker.disconnect()
        await until(lambda: service.duplex.queued_s == 0 and service.duplex.stats()["dropped_s"] > 0)
        await until(lambda: not service.speakers)
        await listener.disconnect()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)

    asyncio.run(asyncio.wait_for(talk(), 60))
    np.testing.assert_array_equal(
        np.frombuffer((tmp_path / "played").read_bytes(), "<i2")[:10_000] / 32768, from_pcm16(as_pcm16(NOISE))[:10_000]
    )


def test_a_loudspeaker_that_is_not_there_silences_nothing_else(caplog):
    service = EgoService("true", NOBODY, EgoFilter(engine="linear"))
    asyncio.run(service.say(AudioChunk(RATE, 2, 1, as_pcm16(NOISE))))
    assert "cannot be reached" in caplog.text and service.duplex.queued_s == 0


def test_a_loudspeaker_that_is_stopped_drops_what_it_has_and_can_be_used_again(tmp_path):
    player = Player(f"{sys.executable} -c 'import time; time.sleep(60)'", AudioFormat(RATE, 2, 1))

    async def talk():
        for _ in range(2):
            await player.write(AudioChunk(RATE, 2, 1, as_pcm16(NOISE[:100])))
            process = player._process
            await player.stop()
            assert process.returncode == -9

    asyncio.run(asyncio.wait_for(talk(), 30))


def test_what_cannot_be_served_is_one_line(capsys, tmp_path):
    words = ["--microphone", "true", "--loudspeaker", "true", "--profile", str(tmp_path / "missing.npz")]
    assert main(words) == 1
    said = capsys.readouterr().err
    assert said.startswith("edgefilter: ") and "missing.npz" in said and said.count("\n") == 1
