"""Where the time of the path goes: milliseconds per hop and stage, back to back on one core, and the real-time factor.

    OMP_NUM_THREADS=1 taskset -c 0 python bench/path_cost.py --output bench/results/path_cost

Runs the bundled demo recording (16 s, simulated) --repeats times after one warm-up pass that is not counted.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import soundfile
from table import machine

import edgefilter
from edgefilter import engines
from edgefilter.profile import Profile
from edgefilter.stream import Stream
from edgefilter.types import SAMPLE_RATE

DEMO = Path(edgefilter.__file__).parent / "demo_data"
ENGINES = ("bypass", "paper-ss", "linear", "ss")


class Clock:
    """Wraps a method and notes how long each call took."""

    def __init__(self, owner: object, method: str, times: list[float]) -> None:
        inner = getattr(owner, method)

        def timed(*arguments: object) -> object:
            start = time.perf_counter()
            result = inner(*arguments)
            times.append(1000 * (time.perf_counter() - start))
            return result

        setattr(owner, method, timed)


def measure(name: str, mic: np.ndarray, ref: np.ndarray, profile: Profile, repeats: int) -> dict[str, object]:
    """Stage -> milliseconds of every call, over all repeats."""
    engine = engines.create(name, profile)
    hop = engine.stft.hop
    stages: dict[str, list[float]] = defaultdict(list)
    for turn in range(repeats + 1):
        stream = Stream(engine, profile)
        times = stages if turn else defaultdict(list)
        front = stream.front
        for stage, owner, method in (
            ("alignment", front.aligner, "step"),
            ("canceller", front.canceller, "step"),
            ("residual", front.residual, "step"),
            ("analysis", front._analyser, "push"),
            ("synthesis", stream._synthesiser, "push"),
        ):
            if owner is not None:
                Clock(owner, method, times[stage])
        for at in range(0, mic.size - hop + 1, hop):
            start = time.perf_counter()
            stream.process(mic[at : at + hop], ref[at : at + hop])
            times["whole path"].append(1000 * (time.perf_counter() - start))
    seconds = repeats * mic.size / SAMPLE_RATE
    rows = {}
    for stage, values in stages.items():
        p50, p95, p99 = np.percentile(values, (50, 95, 99))
        rows[stage] = {"mean_ms": float(np.mean(values)), "p50_ms": p50, "p95_ms": p95, "p99_ms": p99, "max_ms": max(values)}
    return {"hop": hop, "real_time_factor": sum(stages["whole path"]) / 1000 / seconds, "stages": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--output", type=Path, required=True, help="without suffix; .json and .md are written")
    args = parser.parse_args()
    mic, ref = (soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference"))
    profile = Profile.load(DEMO / "profile.npz")
    results = {name: measure(name, mic, ref, profile, args.repeats) for name in ENGINES}
    about = ", ".join(f"{key} {value}" for key, value in machine().items())
    lines = ["# Cost of the path", "", about, "", f"{args.repeats} passes over the bundled recording, hop by hop, back to back, one thread.", ""]
    lines += ["| engine | stage | mean | p50 | p95 | p99 | max, ms per hop |", "| --- | --- | --- | --- | --- | --- | --- |"]
    for name, result in results.items():
        for stage, row in sorted(result["stages"].items(), key=lambda item: -item[1]["mean_ms"]):
            lines.append(f"| {name} | {stage} | " + " | ".join(f"{row[key]:.3f}" for key in ("mean_ms", "p50_ms", "p95_ms", "p99_ms", "max_ms")) + " |")
    lines += ["", "| engine | hop, samples | real-time factor, one core |", "| --- | --- | --- |"]
    lines += [f"| {name} | {result['hop']} | {result['real_time_factor']:.4f} |" for name, result in results.items()]
    args.output.with_suffix(".json").write_text(json.dumps({"about": about, "results": results}, indent=1) + "\n")
    args.output.with_suffix(".md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
