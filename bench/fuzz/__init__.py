"""Damaged files by the million: loaders refuse them in one line, and what they accept keeps the filter's promises.

    python -m bench fuzz --inputs 1000000 --minutes 60 --output bench/results/fuzz
    python -m bench fuzz --clients --minutes 10       (bench/fuzz/clients.py)

Each input is a real file damaged at random, a pure function of seed and number: `--start NUMBER --inputs 1` makes one
again. A find is a file that is not refused by one EdgefilterError of one line, that breaks a promise after it was taken,
or takes longer than PATIENCE_S. Where the process itself dies (a codec, onnxruntime) that is one as well, and another
process goes on behind it. Exit code 1 where there are finds.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import resource
import signal
import tempfile
import time
import traceback
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized, SynchronizedArray
from pathlib import Path

from tqdm import tqdm

from bench import provenance, results
from bench.fuzz.targets import NETWORKS, TARGETS, Target
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.budget import DEMO

PATIENCE_S = 10
"""Seconds of the processor after which an input hangs; a busy machine takes longer by the clock."""
MEMORY = 4 << 30
"""Bytes of address space that the loading process has, libraries included."""
LONGEST = 1200
"""Characters of the one line, the path included."""
COLUMNS = ("taken", "refused", "found")
NOTES = f"""Real files of the demo and of the tests, damaged at random: bytes anywhere; in profiles also values, shapes and types
with sound checksums. Refused: one EdgefilterError of one line. What is taken is used: frames for models, in one of 40
cases two seconds through the filter for profiles. {PATIENCE_S} s and {MEMORY >> 30} GiB each at most."""


class Hang(BaseException):
    """An input took longer than PATIENCE_S; no `except Exception` on the way may take it."""


@dataclass(frozen=True)
class Work:
    """What a loading process does; number and counts (a row of COLUMNS a target) are shared memory that outlives it."""

    start: int
    end: int
    seed: int
    until: float
    only: str | None
    keep: Path | None
    folder: Path
    number: Synchronized
    counts: SynchronizedArray

    def count(self, target: Target, outcome: str) -> None:
        """Note what came of the input at hand; a find also in a file."""
        kind = outcome if outcome in COLUMNS else "found"
        self.counts[TARGETS.index(target) * len(COLUMNS) + COLUMNS.index(kind)] += 1
        if kind == "found":
            with (self.folder / "finds.jsonl").open("a") as file:
                print(json.dumps({"number": self.number.value, "loader": target.name, "what": outcome}), file=file)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--inputs", type=int, default=1_000_000, help="default: %(default)s")
    add("--start", type=int, default=0, metavar="NUMBER", help="of the first input")
    add(
        "--minutes",
        type=float,
        help="stop after so many (default: with --clients 10, otherwise when all inputs are done)",
    )
    add("--clients", action="store_true", help="hostile clients of the services, in place of damaged files")
    add("--only", choices=[target.name for target in TARGETS], help="one loader alone")
    add("--keep", type=Path, metavar="DIR", help="keep the files that were finds")


def run(options: argparse.Namespace) -> str:
    """Start loading processes until all is done; one that dies is a find, and the next begins behind it."""
    if options.clients:
        from bench.fuzz import clients

        options.minutes = 10.0 if options.minutes is None else options.minutes
        return clients.run(options)
    made_with = provenance.stamp({"DEMO": [DEMO], "NETWORKS": [NETWORKS]})
    context = multiprocessing.get_context("spawn")
    number, counts = context.Value("q", options.start), context.Array("q", len(TARGETS) * len(COLUMNS))
    began, at, end, deaths = time.time(), options.start, options.start + options.inputs, []
    until = began + 60 * (1e6 if options.minutes is None else options.minutes)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as name:
        folder = Path(name)
        while at < end and time.time() < until:
            work = Work(at, end, options.seed, until, options.only, options.keep, folder, number, counts)
            process = context.Process(target=load_all, args=(work,))
            process.start()
            process.join()
            at = number.value + 1
            if process.exitcode:
                loader = generator(options.seed, number.value).choice(drawn(options.only)).name
                died = f"the process died ({process.exitcode})"
                deaths.append({"number": number.value, "loader": loader, "what": died})
        lines = (folder / "finds.jsonl").read_text().splitlines() if (folder / "finds.jsonl").exists() else []
    finds = [*map(json.loads, lines), *deaths]
    width = len(COLUMNS)
    loaders = {t.name: dict(zip(COLUMNS, counts[i * width : (i + 1) * width])) for i, t in enumerate(TARGETS)}
    files = at - options.start
    rows = [[name, sum(row.values()), *row.values()] for name, row in loaders.items()]
    first = [[find[key] for key in ("number", "loader", "what")] for find in finds[:50]]
    tables = [results.table("loaders", "What came of them", ["loader", "files", *COLUMNS], rows),
              results.table("finds", f"{len(finds)} finds", ["input", "loader", "find"], first)]  # fmt: skip
    page = results.write(options.output, "fuzz", f"{files} damaged files", made_with, tables, notes=NOTES,
                         minutes=(time.time() - began) / 60, inputs=files, loaders=loaders, finds=finds)  # fmt: skip
    if finds:
        raise UsageError(f"{len(finds)} finds in {files} files, {finds[0]['what']} first")
    return page


def generator(seed: int, number: int) -> random.Random:
    """Of one input; the first thing that it decides is the loader."""
    return random.Random(f"{seed}:{number}")


def drawn(only: str | None) -> list[Target]:
    return [target for target in TARGETS if only in (None, target.name) for _ in range(target.share)]


def load_all(work: Work) -> None:
    """One damaged file after the other, in a process of its own."""
    os.environ["XDG_CACHE_HOME"] = str(work.folder)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, _hang)
    choice = drawn(work.only)
    seeds = {target.name: target.seeds(work.folder) for target in dict.fromkeys(choice)}
    for number in tqdm(range(work.start, work.end), disable=None, mininterval=10.0):
        if time.time() > work.until:
            break
        work.number.value = number
        rng = generator(work.seed, number)
        target = rng.choice(choice)
        data = target.mutate(rng.choice(seeds[target.name]), rng)
        path = work.folder / f"input{target.suffix}"
        path.write_bytes(data)
        outcome = attempt(target, path, rng)
        work.count(target, outcome)
        if outcome not in COLUMNS and work.keep:
            work.keep.mkdir(parents=True, exist_ok=True)
            (work.keep / f"{target.name}_{number}{target.suffix}").write_bytes(data)


def attempt(target: Target, path: Path, rng: random.Random) -> str:
    """What came of one input: "taken", "refused", or what is wrong."""
    signal.setitimer(signal.ITIMER_PROF, PATIENCE_S)
    try:
        target.attempt(path, rng)
        return "taken"
    except EdgefilterError as error:
        line = str(error)
        return "refused" if line.isprintable() and 0 < len(line) < LONGEST else f"no single line: {line[:200]!r}"
    except Hang:
        return f"more than {PATIENCE_S} s"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        return f"{type(error).__name__}: {' '.join(str(error).split())[:200]} ({where})"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _hang(number: int, frame: object) -> None:
    raise Hang
