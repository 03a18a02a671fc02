"""The loading process: one damaged file after the other, counted where a process that dies leaves it behind."""

from __future__ import annotations

import argparse
import json
import random
import resource
import signal
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench.fuzz.targets import TARGETS, Target, working_in
from edgefilter.errors import EdgefilterError

PATIENCE_S = 10
"""Seconds of the processor after which an input hangs; a busy machine takes longer by the clock."""
MEMORY = 4 << 30
"""Bytes of address space that the process has, libraries included."""
LONGEST = 1200
"""Characters of the one line, the path included."""
COLUMNS = ("taken", "refused", "found")


class Hang(BaseException):
    """An input took longer than PATIENCE_S; no `except Exception` on the way may take it."""


class Counts:
    """Number of the input at hand and outcomes so far, in a mapped file; finds as lines of another."""

    def __init__(self, folder: Path) -> None:
        self._finds = folder / "finds.jsonl"
        path = folder / "counts"
        fresh = not path.exists()
        self._table = np.memmap(path, np.int64, "w+" if fresh else "r+", shape=(1 + len(TARGETS), len(COLUMNS)))

    @property
    def number(self) -> int:
        return int(self._table[0, 0])

    def begin(self, number: int) -> None:
        """The input at hand, before anything can go wrong with it."""
        self._table[0, 0] = number

    def end(self, target: Target, outcome: str) -> None:
        """What came of it."""
        kind = outcome if outcome in COLUMNS else "found"
        self._table[1 + TARGETS.index(target), COLUMNS.index(kind)] += 1
        if kind == "found":
            with self._finds.open("a") as file:
                print(json.dumps({"number": self.number, "loader": target.name, "what": outcome}), file=file)

    def finds(self) -> list[dict]:
        return [json.loads(line) for line in self._finds.read_text().splitlines()] if self._finds.exists() else []

    def table(self) -> dict[str, dict[str, int]]:
        """Outcomes by loader."""
        return {target.name: dict(zip(COLUMNS, map(int, row))) for target, row in zip(TARGETS, self._table[1:])}


def target_of(seed: int, number: int, only: str | None) -> Target:
    """Which loader an input is for: the first thing that its generator decides."""
    return generator(seed, number).choice(drawn(only))


def generator(seed: int, number: int) -> random.Random:
    return random.Random(f"{seed}:{number}")


def drawn(only: str | None) -> list[Target]:
    return [target for target in TARGETS if only in (None, target.name) for _ in range(target.share)]


def work(args: argparse.Namespace) -> int:
    """Inputs until there are no more, or the time is over."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, _hang)
    counts, choice = Counts(args.worker), drawn(args.only)
    began, used = time.monotonic(), time.process_time()
    with working_in(args.worker), tqdm(total=args.inputs, disable=None, mininterval=10.0) as bar:
        seeds = {target.name: target.seeds() for target in dict.fromkeys(choice)}
        for number in range(args.start, args.start + args.inputs):
            counts.begin(number)
            rng = generator(args.seed, number)
            target = rng.choice(choice)
            data = target.mutate(rng.choice(seeds[target.name]), rng)
            path = args.worker / f"input{target.suffix}"
            path.write_bytes(data)
            outcome = attempt(target, path, rng)
            counts.end(target, outcome)
            if outcome not in COLUMNS and args.keep:
                args.keep.mkdir(parents=True, exist_ok=True)
                (args.keep / f"{target.name}_{number}{target.suffix}").write_bytes(data)
            bar.update()
            if number % 64 == 0:
                time.sleep(max(0.0, (time.process_time() - used) / args.share - (time.monotonic() - began)))
                if time.monotonic() - began > 60 * args.minutes:
                    break
    return 0


def attempt(target: Target, path: Path, rng: random.Random) -> str:
    """What came of one input: "taken", "refused", or what is wrong."""
    signal.setitimer(signal.ITIMER_PROF, PATIENCE_S)
    try:
        target.attempt(path, rng)
        return "taken"
    except EdgefilterError as error:
        line = str(error)
        return "refused" if line and "\n" not in line and len(line) < LONGEST else f"no single line: {line[:200]!r}"
    except Hang:
        return f"more than {PATIENCE_S} s"
    except Exception as error:
        trace = error.__traceback__
        while trace and trace.tb_next:
            trace = trace.tb_next
        where = f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}" if trace else ""
        return f"{type(error).__name__}: {' '.join(str(error).split())[:200]} ({where})"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _hang(number: int, frame: object) -> None:
    raise Hang
