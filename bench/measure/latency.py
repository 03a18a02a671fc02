"""Latency and cost of the whole path, per hop, beside SpeexDSP and WebRTC AEC3.

Writes JSON, a Markdown page and a picture.

    python -m bench.measure.latency --output bench/results/latency          (13 minutes, on a machine left alone)
    python -m bench.measure.latency --output /tmp/latency --quick           (a minute, coarse)

Every measurement is a process of its own, held to two cores. Contenders take turns, in reversed order every other
round, so that a change of the machine's speed meets all of them. Paced: a hop begins when a device would deliver it,
the processor idles in between. Busy: each of the two cores also runs a process that never rests; such rows are paced
and of one thread only. A second thread is allowed to our engines alone: the peers have none to use. The sound is the
bundled conversation (simulated robot), from its start in every round.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from bench import results_writer
from bench.measure import latency_live, latency_report
from bench.measure.intervals import percentiles
from bench.measure.latency_hops import DEMO, PEERS, WARM_UP_S
from edgefilter import engines
from edgefilter.engines.ladder import CANDIDATES
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE

CORES = 2
QUANTILES = (0, 5, 25, 50, 75, 90, 95, 98, 99, 99.5, 99.9, 100)
TAILS = (1024, 2048, 4096, 6400, 8192)
HOPS = (64, 128, 160, 256, 320, 512)


def contenders() -> tuple[list[str], dict[str, str]]:
    """Whatever can run here, and why the rest cannot."""
    usable, missing = ["bypass"], {}
    for name in reversed(CANDIDATES):
        try:
            engines.create(name)
            usable.append(name)
        except EdgefilterError as error:
            missing[name] = str(error)
    return [*usable, *PEERS], missing


def run_hops(
    contender: str, seconds: float, paced: bool, threads: int = 1, learning: bool = False, **more: object
) -> dict:
    """One child's answer; more: taps, hop, model (the path of another network for crnn)."""
    command = [
        sys.executable,
        "-m",
        "bench.measure.latency_hops",
        "--contender",
        contender,
        "--seconds",
        str(seconds),
        "--cores",
        str(CORES),
    ]
    command += ["--paced"] if paced else []
    command += ["--learning"] if learning else []
    model = more.pop("model", None)
    for option, value in more.items():
        command += [f"--{option}", str(value)]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), **({"EDGEFILTER_CRNN": str(model)} if model else {})}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed:\n{done.stderr}")
    return json.loads(done.stdout)


@contextmanager
def load(busy: bool) -> Iterator[None]:
    """While busy, every core that is measured on has a process that only counts."""
    cores = sorted(os.sched_getaffinity(0))[:CORES] if busy else []
    processes = [
        subprocess.Popen([sys.executable, "-c", f"import os\nos.sched_setaffinity(0, [{core}])\nwhile True: pass"])
        for core in cores
    ]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def figures(took: Sequence[float], hop: int) -> dict:
    """Milliseconds per hop in quantiles, hops longer than themselves, and the part of real time."""
    quantiles = dict(zip(map(str, QUANTILES), percentiles(took, *QUANTILES).values(), strict=True))
    period = 1000 * hop / SAMPLE_RATE
    missed = int(np.sum(np.array(took) > period))
    return {"hops": len(took), "mean": float(np.mean(took)), "missed": missed, "quantiles": quantiles,
            "real_time_factor": float(np.mean(took) / period)}  # fmt: skip


def slowest(run: dict, count: int = 10) -> list[dict]:
    """The slowest hops: where in the conversation, how long, and the stage that took most of it."""
    first = round(WARM_UP_S * SAMPLE_RATE / run["hop"])
    worst = np.argsort(run["took"])[::-1][:count]
    stages = {name: times for name, times in run["stages"].items() if len(times) == len(run["took"])}
    rows = []
    for at in worst:
        longest = max(stages, key=lambda name: stages[name][at]) if stages else None
        place = (first + int(at)) * run["hop"] / SAMPLE_RATE
        rows.append(
            {
                "second": place,
                "ms": run["took"][at],
                "stage": longest,
                "stage_ms": stages[longest][at] if longest else None,
            }
        )
    return rows


def matrix(
    names: Sequence[str], seconds: float, rounds: int, threads: Sequence[int], loads: Sequence[bool]
) -> list[dict]:
    """Every contender under every condition, in turns.

    The peers with one thread, busy cores with one thread and paced.
    """
    rows = []
    for busy in loads:
        for count in threads[:1] if busy else threads:
            for paced in (True,) if busy else (False, True):
                runs: dict[str, list[dict]] = defaultdict(list)
                present = [name for name in names if count == 1 or name not in PEERS]
                with load(busy):
                    for turn in range(rounds):
                        for name in present if turn % 2 == 0 else present[::-1]:
                            runs[name].append(run_hops(name, seconds, paced, count))
                for name in present:
                    rows.append(
                        {"contender": name, "paced": paced, "threads": count, "busy": busy, **summary(runs[name])}
                    )
                print(
                    f"{'busy' if busy else 'idle'}, {count} threads, {'paced' if paced else 'back to back'}: done",
                    file=sys.stderr,
                )
    return rows


def summary(runs: list[dict]) -> dict:
    """Several runs of one contender as one row."""
    hop = runs[0]["hop"]
    stages = {name: figures(sum((run["stages"][name] for run in runs), []), hop) for name in runs[0]["stages"]}
    slow = sorted((row for run in runs for row in slowest(run)), key=lambda row: -row["ms"])[:10]
    memory = max(run["peak_memory_mb"] for run in runs)
    pairs = [(run["stages"].get("alignment", ()), run["stages"].get("canceller", ())) for run in runs]
    front = [a + b for first, second in pairs for a, b in zip(first, second)]
    both = {"front": figures(front, hop)} if front else {}
    return {
        "hop": hop,
        **figures(sum((run["took"] for run in runs), []), hop),
        **both,
        "stages": stages,
        "slowest": slow,
        "peak_memory_mb": memory,
    }


def curves(
    names: Sequence[str], seconds: float, tails: Sequence[int], hops: Sequence[int], models: Sequence[Path]
) -> dict[str, list[dict]]:
    """Cost back to back on one thread, by tail length and hop of `ss` and by size of the network of `crnn`."""
    found: dict[str, list[dict]] = {"tail": [], "hop": [], "model": []}
    for taps in tails:
        found["tail"].append({"x": taps, **summary([run_hops("ss", seconds, False, taps=taps)])})
    for hop in hops:
        found["hop"].append({"x": hop, **summary([run_hops("ss", seconds, False, hop=hop)])})
    for model in sorted(models, key=lambda file: file.stat().st_size) if "crnn" in names else ():
        found["model"].append(
            {"x": model.stat().st_size, "name": model.name, **summary([run_hops("crnn", seconds, False, model=model)])}
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="without suffix; .json, .md and .png are written")
    parser.add_argument("--seconds", type=float, default=12.0, help="of audio in each round")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--models", type=Path, nargs="*", default=[], help="networks for the curve of cost over size")
    parser.add_argument("--quick", action="store_true", help="one short round, one thread, one click")
    parser.add_argument(
        "--no-devices", action="store_true", help="leave out the click through virtual devices (needs PulseAudio)"
    )
    args = parser.parse_args()
    names, missing = contenders()
    seconds, rounds, threads, repeats = (1.0, 1, (1,), 1) if args.quick else (args.seconds, args.rounds, (1, 2), 5)
    tails, hops = (TAILS[-1:], HOPS[-1:]) if args.quick else (TAILS, HOPS)
    before = os.getloadavg()[0]
    ours = [name for name in names if name not in PEERS]
    live = () if args.no_devices else (latency_live.ALONE, *ours)
    made_with = results_writer.stamp({"DEMO": [DEMO]}, ours, {model.name: model for model in args.models})
    result = {
        "conditions": {"threads": "1 and 2", "cores": f"{CORES} of {os.cpu_count()}", "kernel": platform.release(),
                       "load average before": f"{before:.2f}"},
        "seconds": seconds, "rounds": rounds, "missing": missing,
        "rows": matrix(names, seconds, rounds, threads, (False, True)),
        "curves": curves(names, min(seconds, 8.0), tails, hops, args.models),
        "start": {name: [latency_live.start(name) for _ in range(repeats)] for name in ours},
        "click": {name: latency_live.round_trip(name, repeats) for name in live},
    }  # fmt: skip
    latency_report.draw(result, args.output)
    page = latency_report.markdown(result, args.output.name)
    print(results_writer.write(args.output, made_with, "Latency and cost per hop", page, result))


if __name__ == "__main__":
    main()
