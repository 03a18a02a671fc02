"""Hostile clients of `edgefilter serve` and of the Wyoming service: their bytes, orders and sizes, beside a client in real time.

Each attack is a pure function of seed and number, as the damaged files are. A find: a service that dies, has taken more than
MOST_MB beside what it began with, writes a traceback or a line that does not only print, or whose other client gets its
answers later than LATE times what a client of a second service takes at the same time, which nobody attacks, or not at all.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import IO

import numpy as np
from wyoming.audio import AudioChunk
from wyoming.client import AsyncClient

from bench import provenance, results
from bench.fuzz.targets import damaged, damaged_json, sound
from bench.metrics import percentiles
from bench.serve import clients as streams
from edgefilter.errors import UsageError
from edgefilter.filter.budget import DEMO
from edgefilter.integrations.opus import Encoder
from edgefilter.integrations.wire import HEADER
from edgefilter.types import SAMPLE_RATE

MOST_MB = 600
"""What attackers may make a service keep, most of it messages of 4 MB that have come in part: four of them, and as many that
were cut off and are not forgotten yet."""
LATE, HOP_MS = 3.0, 16.0
"""How much later than of the service that is left alone the slowest hundredth of answers may be, and at any rate by two hops:
there are two cores for all."""
ATTACKERS, PART_S = 4, 10.0
"""Clients that attack at once, and seconds after which the figures of the client in real time are taken."""
SILENT_S = 1.0
"""Longest time without the microphone's sound for a listener of the Wyoming service."""
NOISE = (
    "import sys, time; part = bytes(range(256)) * 4\nwhile True: sys.stdout.buffer.write(part); sys.stdout.flush();"
    " time.sleep(0.032)"
)
"""A microphone, as a program: 1024 bytes at the real pace."""
FORMS = (
    {}, {"rate": 48000}, {"streams": "two"}, {"streams": "two", "late_ms": 2000, "microphones": 8, "rate": 48000},
    {"streams": "two", "rate": 48000, "codec": "opus"}, {"microphones": 3}, {"learn": True},
)  # fmt: skip
"""First messages of honest clients."""
SIZES = (0, 1, 2, 12, 13, 320, 640, 1000, 65536, 400_000, 3_999_996, 4_000_001)
"""Bytes of a message."""


def frame(opcode: int, data: bytes, last: bool = True) -> bytes:
    """A frame of a WebSocket's client (RFC 6455, 5.2), its mask of zeros."""
    form, size = len(data), b""
    if form > 125:
        form, size = (126, form.to_bytes(2, "big")) if form < 1 << 16 else (127, form.to_bytes(8, "big"))
    return bytes((last << 7 | opcode, 0x80 | form)) + size + bytes(4) + data


def websocket(rng: random.Random) -> bytes:
    """All that one client sends to the service."""
    form = rng.choice(FORMS)
    hello = json.dumps(form).encode()
    asked = "GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    asked += (
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n" + "Authorization: x\r\n" * rng.choice((0, 0, 0, 2)) + "\r\n"
    )
    parts = [asked.encode(), frame(1, damaged_json(hello, rng) if form and rng.random() < 0.2 else hello)]
    parts += [part for message in _messages(form, rng) for part in _frames(message, rng)]
    whole = b"".join(parts)
    return damaged(whole, rng) if rng.random() < 0.3 else whole


def _messages(form: dict, rng: random.Random) -> Iterator[bytes | str]:
    """Messages of a client whose first one is form: sound of all sizes, numbers and counters that do what they want."""
    size = rng.choice(SIZES)
    many = min(rng.choice((1, 10, 100, 1000)), 20_000_000 // (size + 100))
    packets = Encoder(24000).push(sound()[0], last=True) if form.get("codec") == "opus" else [rng.randbytes(size)]
    step, ahead = rng.choice((0, 1, 1, 1, 2, 3, 32768)), rng.choice((0, size // 2, size // 2, 1, 470_000, 1 << 40))
    for number in range(many):
        kind = rng.random()
        if kind < 0.03:
            yield json.dumps({"kind": rng.choice(("announce", "announce", "end", "\x1b[2J\n", "x" * 5000))})
        elif kind < 0.04:
            yield "[" * rng.choice((1, 5000, 1_000_000))
        data = rng.choice(packets)
        data = damaged(data, rng) if rng.random() < 0.1 else data
        label = rng.choice((0, 1, 1, rng.randrange(256) if rng.random() < 0.1 else 0))
        two = form.get("streams") == "two"
        yield (HEADER.pack(label, number * step % 65536, number * ahead % (1 << 64)) if two else b"") + data


def _frames(message: bytes | str, rng: random.Random) -> Iterator[bytes]:
    """A message in one frame or in many, with others of no use between them."""
    data, kind = (message.encode(), 1) if isinstance(message, str) else (message, 2)
    if rng.random() < 0.02:
        yield frame(rng.choice((8, 9, 9, 10, 3, 15)), rng.randbytes(rng.choice((0, 2, 125)))) * rng.choice(
            (1, 50, 50_000)
        )
    pieces = rng.choice((1, 1, 1, 1, 2, 5, 2000))
    size = -(-len(data) // pieces) or 1
    for at in range(pieces):
        yield frame(0 if at else kind, data[at * size : at * size + size], last=at == pieces - 1)


def wyoming(rng: random.Random) -> bytes:
    """All that one client sends to a Wyoming service."""
    lines = []
    size = rng.choice(SIZES)
    for _ in range(min(rng.choice((1, 10, 100, 10_000)), 20_000_000 // (size + 100))):
        kind = rng.choice(
            ("audio-start", "audio-chunk", "audio-chunk", "audio-chunk", "audio-stop", "describe", "\x1b[2J")
        )
        form = {"rate": rng.choice((16000, 22050, 8000, 1)), "width": rng.choice((2, 2, 2, 4, 0)), "channels": 1}
        said = {"type": kind, "data": form}
        if kind == "audio-chunk":
            said["payload_length"] = rng.choice((size, size, size, 10**12, -1, "\n"))
        if rng.random() < 0.02:
            said["data_length"] = rng.choice((10, 1 << 20, 10**9))
        line = json.dumps(said).encode()
        lines.append((damaged_json(line, rng) if rng.random() < 0.02 else line) + b"\n")
        lines.append(rng.randbytes(size) if kind == "audio-chunk" else b"")
    whole = b"".join(lines)
    return damaged(whole, rng) if rng.random() < 0.3 else whole


def attack(port: int, sent: bytes, rng: random.Random) -> None:
    """Send it at once, in pieces or in part, read the answers or not, and go, or stay for a while."""
    reads, piece, stays = rng.random() < 0.7, rng.choice((1 << 20, 1 << 20, 1400, 7)), rng.choice((0.0, 0.1, 2.0))
    until = time.monotonic() + rng.choice((1.0, 5.0))
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), 5) as client:
        client.settimeout(0.05)
        at = 0
        while time.monotonic() < until:
            if reads or at >= len(sent):
                with suppress(TimeoutError):
                    if not client.recv(1 << 16):
                        return
            if at < len(sent):
                with suppress(TimeoutError):
                    at += client.send(sent[at : at + piece])
            elif time.monotonic() > until - 1.0 + stays:
                return


def attack_all(seed: int, first: int, ports: dict[str, int], number: object, stopping: Event) -> None:
    """Attack after attack, in a process of its own, which takes no time from the services: real ones are elsewhere."""
    os.nice(10)
    for at in range(first, 1 << 40, ATTACKERS):
        if stopping.is_set():
            return
        number.value = at  # type: ignore[attr-defined]
        rng = random.Random(f"{seed}:{at}")
        name = rng.choice(list(ports))
        attack(ports[name], websocket(rng) if name == "serve" else wyoming(rng), rng)


def resident_mb(process: int) -> float:
    """Memory that a process has at present (Linux)."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def free_ports(count: int) -> list[int]:
    with ExitStack() as held:
        found = [held.enter_context(socket.socket()) for _ in range(count)]
        for each in found:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in found]


class Watched:
    """A service under attack, as a command; what it writes, and the most memory that it had."""

    def __init__(self, name: str, command: list[str], port: int) -> None:
        self.name, self.lines, self._wrong = name, 0, ""
        self.process = subprocess.Popen([sys.executable, *command], stderr=subprocess.PIPE, cwd=results.ROOT)
        until = time.monotonic() + 60
        while time.monotonic() < until and self.process.poll() is None:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                break
            time.sleep(0.2)
        else:
            raise UsageError(f"{name} did not start")
        assert self.process.stderr is not None
        threading.Thread(target=self._read, args=(self.process.stderr,), daemon=True).start()
        self.before = self.most = resident_mb(self.process.pid)

    def _read(self, lines: IO[bytes]) -> None:
        for line in lines:
            self.lines += 1
            text = line.decode(errors="replace").rstrip("\n")
            if not text.isprintable() or text.startswith("Traceback"):
                self._wrong = self._wrong or text

    def wrong(self) -> str:
        """What is wrong with it now, if anything is."""
        if self.process.poll() is not None:
            return f"{self.name} died ({self.process.returncode})"
        self.most = max(self.most, resident_mb(self.process.pid))
        if self.most > self.before + MOST_MB:
            return f"{self.name} takes {self.most:.0f} MB, {self.before:.0f} before"
        return f"{self.name} wrote {self._wrong!r}" if self._wrong else ""


async def beside(
    ports: Sequence[int], listen: int, watched: list[Watched], seconds: float
) -> tuple[list[list[float]], float, str]:
    """Milliseconds of the answers of a client in real time of each port, a listener's longest silence in s, and what was wrong."""
    silence = 0.0

    async def listener() -> None:
        nonlocal silence
        client = AsyncClient.from_uri(f"tcp://127.0.0.1:{listen}")
        await client.connect()
        last = time.monotonic()
        while (message := await client.read_event()) is not None:
            if AudioChunk.is_type(message.type):
                silence, last = max(silence, time.monotonic() - last), time.monotonic()

    listening = asyncio.create_task(listener())
    try:
        hop, rng = round(HOP_MS * SAMPLE_RATE / 1000), np.random.default_rng(0)
        both = [streams(f"ws://127.0.0.1:{port}", 1, hop, seconds, rng) for port in ports]
        took = await asyncio.gather(*both)
    except Exception as error:
        return [[] for _ in ports], silence, f"the client in real time: {type(error).__name__}: {error}"
    told = "the listener was let go" if listening.done() else ""
    listening.cancel()
    return took, silence, next(filter(None, (told, *(each.wrong() for each in watched))), "")


def run(options: argparse.Namespace) -> str:
    """Attack both services for so many minutes; the page with the figures. Raises UsageError where there are finds."""
    made_with = provenance.stamp({"DEMO": [DEMO]})
    context = multiprocessing.get_context("spawn")
    serve, quiet, microphone, loudspeaker = free_ports(4)
    ports = {"serve": serve, "microphone": microphone, "loudspeaker": loudspeaker}
    served, stopping = (serve, quiet), context.Event()
    numbers = [context.Value("q", -1) for _ in range(ATTACKERS)]
    finds: list[str] = []
    with ExitStack() as ended:
        folder = ended.enter_context(tempfile.TemporaryDirectory())
        (Path(folder) / "noise.py").write_text(NOISE)
        heard = f"{sys.executable} {folder}/noise.py"
        uris = ["--mic-uri", f"tcp://127.0.0.1:{microphone}", "--snd-uri", f"tcp://127.0.0.1:{loudspeaker}"]
        spoken = ["--microphone", heard, "--loudspeaker", "dd of=/dev/null status=none", "--engine", "linear", *uris]
        service = ["-m", "edgefilter.cli", "serve", "--streams", str(ATTACKERS + 4), "--port"]
        commands = (("serve", serve, [*service, str(serve)]), ("serve, left alone", quiet, [*service, str(quiet)]),
                    ("wyoming", microphone, ["-m", "edgefilter.integrations.wyoming", *spoken]))  # fmt: skip
        watched = []
        for name, port, command in commands:
            watched.append(Watched(name, command, port))
            ended.callback(watched[-1].process.wait)
            ended.callback(watched[-1].process.terminate)
        for at, number in enumerate(numbers):
            words = options.seed, options.start + at, ports, number, stopping
            attacker = context.Process(target=attack_all, args=words)
            attacker.start()
            ended.callback(attacker.join)
        ended.callback(stopping.set)
        while any(number.value < 0 for number in numbers):
            time.sleep(0.1)
        until, longest, wrong = time.monotonic() + 60 * options.minutes, 0.0, ""
        every: list[list[float]] = [[], []]
        while time.monotonic() < until and not (wrong and watched[0].process.poll() is not None):
            took, silence, wrong = asyncio.run(beside(served, microphone, watched, PART_S))
            every, longest = [old + new for old, new in zip(every, took, strict=True)], max(longest, silence)
            if wrong and wrong not in finds:
                finds.append(wrong)
        figures, alone = (
            percentiles(of, 50, 99, 100) if of else {"p50": np.inf, "p99": np.inf, "max": np.inf} for of in every
        )
        late = figures["p99"] > max(LATE * alone["p99"], alone["p99"] + 2 * HOP_MS) or not every[0]
        finds += [f"answers after {figures['p99']:.0f} ms, left alone {alone['p99']:.0f}"] if late else []
        finds += [f"the listener heard nothing for {longest:.1f} s"] if longest > SILENT_S else []
        rows = [[each.name, len(of), *found.values(), each.most] for each, of, found in
                zip(watched, every, (figures, alone), strict=False)]  # fmt: skip
        rows.append([watched[2].name, None, None, None, None, watched[2].most])
        attacks = sum(number.value - options.start for number in numbers) // ATTACKERS
    columns = ["service", "answers", ("p50, ms", 1), ("p99, ms", 1), ("max, ms", 1), ("MB", 0)]
    tables = [results.table("clients", "The clients that do no harm", columns, rows),
              results.table("finds", f"{len(finds)} finds", ["find"], [[find] for find in finds])]  # fmt: skip
    lines = {each.name: each.lines for each in watched}
    notes = f"{options.minutes:g} minutes, {ATTACKERS} attackers at once; lines in the logs: {lines}; the listener's longest silence {longest:.2f} s."
    page = results.write(options.output, "clients", f"{attacks} hostile clients", made_with, tables, notes=notes,
                         attacks=attacks, finds=finds, rows=rows)  # fmt: skip
    if finds:
        raise UsageError(f"{len(finds)} finds among {attacks} hostile clients, {finds[0]} first")
    return page
