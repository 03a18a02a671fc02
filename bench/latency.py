"""Milliseconds of a hop: each engine in the whole path, alone and beside a learner, against SpeexDSP and WebRTC AEC3.

    python -m bench latency --output bench/results/latency            (12 minutes, on a machine left alone)
    python -m bench latency --seconds 1 --rounds 1                    (a minute, coarse)

Every measurement is a process of its own, held to CORES cores, with one thread. Contenders take turns, in reversed order
every other round, so that a change of the machine's speed meets all of them. Paced: a hop begins when a device would
deliver it, the processor idles in between. Beside a learner: another process learns from the same hops. The sound is the
bundled conversation (simulated robot), over and over; the first WARM_UP_S are left out. How soon a fresh process answers is
measured apart, STARTS times.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from bench import peers, provenance, results
from bench.metrics import percentiles
from bench.recordings import progress
from edgefilter import Profile, engines
from edgefilter.engines import CANDIDATES
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.budget import CORES, DEMO, held_to, scene
from edgefilter.filter.echo_path import Learner
from edgefilter.filter.stream import Stream
from edgefilter.filter.timing import peak_memory_mb
from edgefilter.learning.background import BackgroundLearner
from edgefilter.types import SAMPLE_RATE

WARM_UP_S = 0.5
YARDSTICK = "speexdsp"
"""The contender whose paced hop the others are compared with; it has no gain from a second thread."""
PEERS = (YARDSTICK, "speexdsp-suppressed", "aec3")
LEARNING = "-learning"
LEARNERS = ("linear", "crnn")
"""Engines that are also timed beside a learner: the one that leaves it most of the processor, and the one that leaves it least."""
SLOWEST, STARTS = 5, 5
BEGIN = """from edgefilter import EgoFilter; import numpy as np
ego, hop = EgoFilter(engine="crnn"), np.zeros(256, np.float32)
while not ego.process(hop, hop).size: pass
print("heard", flush=True)"""
"""What such a process does: an uncalibrated filter, up to the first block that returns samples."""
PERCENTILES = ("p50", "p95", "p99", "max")
PACE = {True: "paced", False: "back to back"}


@dataclass
class Contender:
    """What is timed: a function of one hop of both channels, and the times of its stages."""

    hop: int
    step: Callable[[np.ndarray, np.ndarray], object]
    dtype: type = np.float32
    stages: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


def engine(name: str, learner: Learner | None = None) -> Contender:
    """An engine in the whole path, started from the bundled profile."""
    profile = Profile.load(DEMO / "profile.npz")
    made = engines.create(name, profile)
    stream = Stream(made, profile, learner=learner)
    contender = Contender(made.stft.hop, stream.process)
    front = stream.front
    parts = [("alignment", front.aligner, "step"), ("analysis", front._analyser, "push"), ("engine", made, "step")]
    if stage := front.linear_stage:
        parts += [("canceller", stage.canceller, "step"), ("residual", stage.residual, "step")]
    parts.append(("overlap-add", stream._synthesiser, "push"))
    for stage_name, owner, method in parts:
        if owner is not None:
            setattr(owner, method, _timed(getattr(owner, method), contender.stages[stage_name]))
    return contender


def peer(name: str, stack: ExitStack) -> Contender:
    """A public canceller at its own frame length, called as its own samples say."""
    if name == "aec3":
        return Contender(peers.AEC3_FRAME, peers.aec3_frames())
    step = stack.enter_context(peers.speexdsp_frames(suppress=name == "speexdsp-suppressed"))
    out = np.zeros(peers.FRAME, np.int16)
    return Contender(peers.FRAME, lambda near, far: step(near, far, out), np.int16)


def _timed(inner: Callable, times: list[float]) -> Callable:
    def timed(*arguments: object, **named: object) -> object:
        start = time.perf_counter()
        result = inner(*arguments, **named)
        times.append(1000 * (time.perf_counter() - start))
        return result

    return timed


def sound(hop: int, dtype: type) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The bundled conversation, hop by hop, over and over."""
    scale = 32767 if dtype is np.int16 else 1
    for mic, ref in scene(hop):
        yield (scale * mic).astype(dtype), (scale * ref).astype(dtype)


def measure(contender: Contender, seconds: float, paced: bool) -> list[float]:
    """Milliseconds of each hop of so many seconds of audio, after the warm-up."""
    hops = sound(contender.hop, contender.dtype)
    period = contender.hop / SAMPLE_RATE if paced else 0.0
    for _ in range(round(WARM_UP_S * SAMPLE_RATE / contender.hop)):
        contender.step(*next(hops))
    for times in contender.stages.values():
        times.clear()
    took: list[float] = []
    began = time.perf_counter()
    for number in range(round(seconds * SAMPLE_RATE / contender.hop)):
        hop = next(hops)
        time.sleep(max(0.0, began + number * period - time.perf_counter()))
        start = time.perf_counter()
        contender.step(*hop)
        took.append(1000 * (time.perf_counter() - start))
    return took


def child(name: str, seconds: float, paced: bool) -> dict:
    base = name.removesuffix(LEARNING)
    with ExitStack() as stack:
        stack.enter_context(held_to(CORES))
        learner = BackgroundLearner() if base != name else None
        contender = peer(name, stack) if name in PEERS else engine(base, learner)
        took = measure(contender, seconds, paced)
        if learner:
            learner.close()
    found = {"hop": contender.hop, "took": took, "stages": dict(contender.stages), "peak_memory_mb": peak_memory_mb()}
    return found | {"learned": learner.stats() if learner else None}


def run_hops(name: str, seconds: float, paced: bool) -> dict:
    """hop, took (ms of each hop), stages (the same of each stage), peak_memory_mb, learned (of the other process)."""
    command = [sys.executable, "-m", "bench.latency", name, str(seconds), str(int(paced))]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=results.ROOT)
    if done.returncode:
        raise UsageError(f"{name} could not be timed: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout)


def start_ms() -> float:
    """Milliseconds until a fresh process has filtered its first sound, the median of STARTS."""
    took = []
    for _ in range(STARTS):
        began = time.perf_counter()
        with subprocess.Popen([sys.executable, "-c", BEGIN], stdout=subprocess.PIPE, cwd=results.ROOT) as process:
            heard = process.stdout.readline() if process.stdout else b""
            took.append(1000 * (time.perf_counter() - began))
        if not heard:
            raise UsageError("the filter returned no sound in a fresh process: try edgefilter demo")
    return float(np.median(took))


def contenders() -> tuple[list[str], dict[str, str]]:
    """Whatever can run here, and why the rest cannot."""
    usable, missing = ["bypass"], {}
    for name in reversed(CANDIDATES):
        try:
            engines.create(name)
            usable += [name, *([name + LEARNING] if name in LEARNERS else [])]
        except EdgefilterError as error:
            missing[name] = str(error)
    return [*usable, *PEERS], missing


def summary(runs: Sequence[Mapping]) -> dict:
    """Several runs of one contender as one row: ms a hop, hops that took longer than they last, part of real time."""
    hop, took = runs[0]["hop"], np.concatenate([run["took"] for run in runs])
    period, mean = 1000 * hop / SAMPLE_RATE, float(took.mean())
    stages = {name: float(np.mean(np.concatenate([run["stages"][name] for run in runs]))) for name in runs[0]["stages"]}
    worst = sorted((row for run in runs for row in slowest(run)), key=lambda row: -row["ms"])[:SLOWEST]
    found = {"hop_ms": period, "hops": took.size, **percentiles(took, 50, 95, 99, 100), "mean": mean}
    found |= {"missed": int(np.sum(took > period)), "real_time_factor": mean / period}
    found |= {"stages": stages, "slowest": worst}
    learned = [run["learned"] for run in runs if run["learned"]]
    return found | {"peak_memory_mb": max(run["peak_memory_mb"] for run in runs), "learned": learned}


def slowest(run: Mapping) -> list[dict]:
    """The slowest hops: second in the sound, ms, and the stage that took most of it."""
    first = round(WARM_UP_S * SAMPLE_RATE / run["hop"])
    stages = {name: times for name, times in run["stages"].items() if len(times) == len(run["took"])}
    rows = []
    for at in np.argsort(run["took"])[::-1][:SLOWEST]:
        stage = max(stages, key=lambda name: stages[name][at]) if stages else ""
        rows.append({"second": (first + int(at)) * run["hop"] / SAMPLE_RATE, "ms": run["took"][at], "stage": stage})
    return rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--contenders", metavar="A,B,...", help="default: all that can run here")
    add("--seconds", type=float, default=12.0, help="of audio in each round (default: %(default)s)")
    add("--rounds", type=int, default=2, help="default: %(default)s")


def run(options: argparse.Namespace) -> str:
    names, missing = contenders()
    names = options.contenders.split(",") if options.contenders else names
    load = os.getloadavg()[0]
    judged = [provenance.TIMED, *(name for name in names if name not in PEERS)]
    made_with = provenance.stamp({"DEMO": [DEMO]}, judged)
    turns = [(name, paced) for paced in (False, True) for name in names]
    runs: dict[tuple[str, bool], list[dict]] = defaultdict(list)
    for number in progress(range(options.rounds), "round"):
        for name, paced in turns if number % 2 == 0 else turns[::-1]:
            runs[name, paced].append(run_hops(name, options.seconds, paced))
    first = results.table("start", "First hop after the start of a process", ["", (f"ms, median of {STARTS}", 0)],
                          [["crnn, uncalibrated", start_ms()]] if "crnn" in names else [])  # fmt: skip
    rows = [{"contender": name, "paced": paced, **summary(runs[name, paced])} for name, paced in turns]
    conditions = f"{options.rounds} rounds of {options.seconds:g} s each, {CORES} of {os.cpu_count()} cores, one thread"
    said = "Milliseconds a hop; missed: hops that took longer than they last."
    notes = [f"{conditions}, load average before {load:.2f}. {said}"]
    notes += [f"{name} is not in the table: {why}" for name, why in missing.items()]
    plots = [results.plot("hops", [_panel(runs, names, paced) for paced in (True, False)])]
    return results.write(options.output, "latency", "Latency and cost per hop", made_with, [*tables(rows), first], plots,
                         "\n\n".join(notes), rows=rows)  # fmt: skip


def tables(rows: Sequence[Mapping]) -> list[dict]:
    """Times, ratios to the yardstick, what a hop is made of, the slowest hops, and what a learner takes."""
    paced = {row["contender"]: row for row in rows if row["paced"]}
    yardstick = paced.get(YARDSTICK)
    cells = []
    for row in rows:
        ratios = [row[key] / yardstick[key] if yardstick and row["paced"] else None for key in ("p50", "p99")]
        kept = [row[key] for key in ("hop_ms", *PERCENTILES, "missed", "real_time_factor")]
        cells.append([row["contender"], PACE[row["paced"]], *kept, *ratios])
    columns = ["", "pace", ("hop, ms", 0), *((key, 3) for key in PERCENTILES), "missed", ("real-time factor", 4)]
    columns += [(f"p50 over {YARDSTICK}'s", 2), ("p99", 2)]
    stages = list(dict.fromkeys(name for row in paced.values() for name in row["stages"]))
    made = [results.table("latency", "Milliseconds a hop", columns, cells)]
    cells = [[name, *map(row["stages"].get, stages), row["mean"]] for name, row in paced.items() if row["stages"]]
    columns = ["", *((stage, 3) for stage in stages), ("whole", 3)]
    made.append(results.table("stages", "What a paced hop is made of, mean ms", columns, cells))
    told = {name: (f"{hop['second']:.2f} s {hop['ms']:.1f} {hop['stage']}".strip() for hop in row["slowest"])
            for name, row in paced.items()}  # fmt: skip
    columns = ["", "second of the sound, ms, the stage that took most"]
    cells = [[name, ", ".join(hops)] for name, hops in told.items()]
    made.append(results.table("slowest", "The slowest paced hops", columns, cells))
    if beside := [_learner(name, row, paced) for name, row in paced.items() if row["learned"]]:
        columns = ["", ("p99 over that without", 2), ("CPU, s a minute", 1), ("memory, MB", 0), ("fits a run", 1)]
        title = "A learner beside it, and what its process takes (its start included)"
        made.append(results.table("learner", title, [*columns, "fell behind"], beside))
    return made


def _learner(name: str, row: Mapping, paced: Mapping[str, Mapping]) -> list:
    alone, learned = paced.get(name.removesuffix(LEARNING)), row["learned"]
    minutes = row["hops"] * row["hop_ms"] / 60_000
    keys = ("cpu_s", "memory_mb", "rounds", "fell_behind")
    cpu_s, memory_mb, rounds, behind = ([one[key] for one in learned] for key in keys)
    ratio = row["p99"] / alone["p99"] if alone else None
    return [name, ratio, sum(cpu_s) / minutes, max(memory_mb), float(np.mean(rounds)), sum(behind)]


def _panel(runs: Mapping[tuple[str, bool], Sequence[Mapping]], names: Sequence[str], paced: bool) -> dict:
    """How many hops are slower than so many ms."""
    slower = np.array([100, 50, 20, 10, 5, 2, 1, 0.5, 0.2])
    took = {name: np.concatenate([run["took"] for run in runs[name, paced]]) for name in names}
    lines = {name: (slower, np.percentile(times, 100 - slower)) for name, times in took.items()}
    return results.panel(PACE[paced], "hops slower than this, %", "ms a hop", lines, xscale="log", yscale="log")


if __name__ == "__main__":
    print(json.dumps(child(sys.argv[1], float(sys.argv[2]), sys.argv[3] == "1")))
