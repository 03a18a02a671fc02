"""Streams that a core serves in real time: more and more clients at once, until an answer in a hundred is late by a hop.

    python -m bench serve --output bench/results/serve           (a few minutes, on a machine left alone)

`edgefilter serve` is held to one core, the clients run on the others. Each client sends the bundled conversation (simulated
robot) as 16-bit stereo, a hop a message, when a device would deliver it; clients begin at random moments within a hop. An
answer's time is from the message that completes its hop to its arrival. The first WARM_UP_S of each client are left out.
Needs `pip install '.[bench,serve]'`.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from websockets.asyncio.client import connect

from bench import provenance, results
from bench.latency import PERCENTILES
from bench.live.virtual_sound import processor_s
from bench.metrics import percentiles
from bench.recordings import progress, read
from edgefilter import engines
from edgefilter.errors import UsageError
from edgefilter.filter.budget import DEMO, held_to
from edgefilter.types import SAMPLE_RATE

WARM_UP_S = 2.0
MOST = 64
"""Streams at which the search ends."""


@contextmanager
def service(engine: str, core: int) -> Iterator[tuple[str, int]]:
    """Address and process number of a service that has this core alone; it ends with the block."""
    command = [sys.executable, "-m", "edgefilter.cli", "serve", "--port", "0", "--streams", str(MOST)]
    command += ["--profile", str(DEMO / "profile.npz"), "--engine", engine]
    held = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=held, cwd=results.ROOT)
    assert process.stderr is not None
    try:
        os.sched_setaffinity(process.pid, {core})
        line = process.stderr.readline()
        if "ws://" not in line:
            raise UsageError(f"edgefilter serve did not start: {line.strip()}")
        yield next(word for word in line.split() if word.startswith("ws://")), process.pid
    finally:
        process.terminate()
        process.wait()


async def client(address: str, messages: list[bytes], period: float, seconds: float, begin: float) -> list[float]:
    """Milliseconds from each message that completes a hop to its answer."""
    async with connect(address, compression=None) as server:
        await server.send(json.dumps({"rate": SAMPLE_RATE}))
        ready = json.loads(await server.recv())
        behind = round(ready["delay_ms"] / 1000 / period) - 1
        sent: list[float] = []

        async def speak() -> None:
            for number in range(round((WARM_UP_S + seconds) / period)):
                await asyncio.sleep(max(0.0, begin + number * period - time.monotonic()))
                sent.append(time.monotonic())
                await server.send(messages[number % len(messages)])
            await server.send(json.dumps({"kind": "end"}))

        speaking = asyncio.create_task(speak())
        took: list[float] = []
        async for answer in server:
            if isinstance(answer, bytes) and (completed := len(took) + behind) < len(sent):
                took.append(1000 * (time.monotonic() - sent[completed]))
        await speaking
    return took[round(WARM_UP_S / period) :]


async def clients(address: str, streams: int, hop: int, seconds: float, rng: np.random.Generator) -> list[float]:
    """What `client` returns, of so many of them."""
    both = np.stack([read(DEMO / f"{name}.flac") for name in ("mic", "reference")], axis=1)
    pcm = np.round(32767 * both).astype("<i2")
    messages = [pcm[at : at + hop].tobytes() for at in range(0, len(pcm) - hop + 1, hop)]
    period, now = hop / SAMPLE_RATE, time.monotonic() + 1.0
    talks = [client(address, messages, period, seconds, now + rng.uniform(0, period)) for _ in range(streams)]
    return [one for took in await asyncio.gather(*talks) for one in took]


def climb(engine: str, seconds: float, rng: np.random.Generator) -> list[dict]:
    """A row for 1, 2, 4, 6, ... streams, up to the first at which the slowest hundredth of answers takes longer than a hop."""
    *others, core = sorted(os.sched_getaffinity(0))
    if not others:
        raise UsageError("this machine has one core, expected one for the service and one for its clients")
    hop, rows = engines.create(engine).stft.hop, []
    with held_to(len(others)), service(engine, core) as (address, process):
        for streams in progress([1, *range(2, MOST + 1, 2)], f"{engine}, streams"):
            spent = processor_s(process)
            took = asyncio.run(clients(address, streams, hop, seconds, rng))
            share = (processor_s(process) - spent) / (streams * (seconds + WARM_UP_S))
            rows.append({"engine": engine, "streams": streams, **percentiles(took, 50, 95, 99, 100), "core_s": share})
            if rows[-1]["p99"] > 1000 * hop / SAMPLE_RATE:
                break
    return rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--engines", default="linear,ss,crnn", metavar="A,B,...", help="default: %(default)s")
    parser.add_argument("--seconds", type=float, default=15.0, help="of each number of streams (default: %(default)s)")


def run(options: argparse.Namespace) -> str:
    names = options.engines.split(",")
    load = os.getloadavg()[0]
    made_with = provenance.stamp({"DEMO": [DEMO]}, [provenance.TIMED, *names])
    rng = np.random.default_rng(options.seed)
    rows = [row for name in names for row in climb(name, options.seconds, rng)]
    times = [(f"{key}, ms", 1) for key in PERCENTILES]
    columns = ["engine", "streams", *times, ("core's time of a stream, s a second", 3)]
    kept = [[row[key] for key in ("engine", "streams", *PERCENTILES, "core_s")] for row in rows]
    most = [[name, in_time(rows, name)] for name in names]
    tables = [results.table("headline", "Streams that a core serves in real time", ["engine", "streams"], most),
              results.table("answers", "How long an answer takes", columns, kept)]  # fmt: skip
    notes = f"{options.seconds:g} s of each, one core for the service, load average before {load:.2f}."
    return results.write(options.output, "serve", "Streams per core", made_with, tables, notes=notes, rows=rows)


def in_time(rows: list[dict], engine: str) -> int:
    """The last number of streams before the one that was late; 0 where one stream was."""
    own = [row for row in rows if row["engine"] == engine]
    hop_ms = 1000 * engines.create(engine).stft.hop / SAMPLE_RATE
    return max((row["streams"] for row in own if row["p99"] <= hop_ms), default=0)
