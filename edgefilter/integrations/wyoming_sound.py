"""Where a Wyoming service's sound comes from and goes to: a command's raw samples, or another service."""

from __future__ import annotations

import asyncio
import shlex

from wyoming.audio import AudioChunk, AudioChunkConverter, AudioFormat, AudioStart, AudioStop
from wyoming.client import AsyncClient
from wyoming.mic import MicProcessAsyncClient

CHUNK = 1024
"""Samples read at once from a microphone that is a command, as satellites do."""


def open_microphone(where: str, form: AudioFormat) -> AsyncClient:
    """A client, to be entered, that reads a command or the service at a URI."""
    if "://" in where:
        return AsyncClient.from_uri(where)
    program, *words = shlex.split(where)
    return MicProcessAsyncClient(form.rate, form.width, form.channels, CHUNK, program, words)


class Player:
    """A loudspeaker that can be silenced: opened with the first sound, and again after each silence."""

    def __init__(self, where: str, form: AudioFormat) -> None:
        self.where, self.form = where, form
        self._convert = AudioChunkConverter(form.rate, form.width, form.channels)
        self._client: AsyncClient | None = None
        self._process: asyncio.subprocess.Process | None = None

    async def write(self, chunk: AudioChunk) -> None:
        """Play chunk after what was written before; raises OSError where there is nothing to play it."""
        if "://" in self.where:
            await self._write_to_service(chunk)
            return
        if self._process is None or self._process.returncode is not None:
            words = shlex.split(self.where)
            self._process = await asyncio.create_subprocess_exec(*words, stdin=asyncio.subprocess.PIPE)
        assert self._process.stdin is not None
        self._process.stdin.write(self._convert.convert(chunk).audio)
        await self._process.stdin.drain()

    async def _write_to_service(self, chunk: AudioChunk) -> None:
        if self._client is None:
            client = AsyncClient.from_uri(self.where)
            await client.connect()
            self._client = client
            await client.write_event(AudioStart(chunk.rate, chunk.width, chunk.channels).event())
        await self._client.write_event(chunk.event())

    async def end(self) -> None:
        """The utterance is complete: what was written is still played."""
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
