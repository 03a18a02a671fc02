"""The long run: an hour of audio faster than real time, or minutes live on a virtual device.

Memory, time per hop and samples must not drift.

    OMP_NUM_THREADS=1 python -m bench.measure.soak --minutes 60 --output bench/results/soak
    OMP_NUM_THREADS=1 python -m bench.measure.soak --minutes 600 --one-way --engine ss --output bench/results/soak_one_way
    OMP_NUM_THREADS=1 python -m bench.measure.soak --live 10 --output bench/results/soak_live    (needs PulseAudio)

Exit code 1 where something drifted. The sound is the bundled conversation over and over, the reference with a clock
that is PPM fast for TURN_S and as much slow for the next, so that the alignment has work to do for ever; --one-way: fast
all the time, so that after some seven hours the lag is beyond all that are looked for. Memory and processor time per
block are read once in every slice, the learner's memory each second, of which the slice has the most; the first tenth
of the run, 15 s at least, is warm-up.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import soundfile

import edgefilter
from bench import results_writer
from bench.measure import picture, virtual_sound
from bench.measure.intervals import percentiles
from edgefilter import EgoFilter
from edgefilter.types import SAMPLE_RATE

DEMO = Path(edgefilter.__file__).parent / "demo_data"
PPM = 50.0
TURN_S = 3600.0
"""After so long the clock that was fast is slow: the buffers of a real machine let no lag grow for ever."""
BLOCK = 320
"""Samples a block, 20 ms: no multiple of any hop."""
GROWTH_MB = 3.0
"""Most growth of memory from the warm-up to the end; an array that grew by one frame a hop would add 115 MB an hour."""
LEARNER_GROWTH_MB = 50.0
"""The same of the learner, its most in the later half over its most in the earlier one. A round's arrays come and go, so
that it swings by 150 MB; 37 minutes that rose to 420 MB by the 13th were 210 to 220 MB whenever the heap was trimmed."""
SETTLING_S, LEARNING_S = 15.0, 60.0
"""Least warm-up of the process itself, and of the learner beside it, whose first lessons are as long as what was heard."""
SLOWER = 1.3
"""Most growth of a block's processor time over that of a bypassed block, second half over first. A shared machine
changes its speed by more than that, and the bypass with it."""


@dataclass
class Slice:
    """Audio so far (s), resident memory, also the learner's most (MB), processor time of a block and of a bypassed one (ms)."""

    seconds: float
    memory_mb: float
    learner_mb: float | None = None
    p50_ms: float | None = None
    p99_ms: float | None = None
    bypass_ms: float | None = None


def memory_mb(pid: int | str = "self") -> float:
    """Resident memory of a process now, MB (Linux); 0 where it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 2**20
    except (FileNotFoundError, ProcessLookupError):
        return 0.0


def children_mb(pid: int) -> float:
    """The same of all processes that it started, and that these started: of a running filter, the learner's."""
    try:
        children = [
            int(child) for task in Path(f"/proc/{pid}/task").glob("*/children") for child in task.read_text().split()
        ]
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return sum(memory_mb(child) + children_mb(child) for child in children)


def ahead(heard: np.ndarray, one_way: bool) -> np.ndarray:
    """Samples that the reference's clock has gained when so many were heard."""
    turn = round(TURN_S * SAMPLE_RATE)
    return PPM * 1e-6 * (heard if one_way else turn - np.abs(heard % (2 * turn) - turn))


def blocks(total: int, one_way: bool = False) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Total samples of the conversation in a loop, the reference on its own clock."""
    mic, ref = (soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference"))
    for at in range(0, total, BLOCK):
        count = min(BLOCK, total - at)
        heard = np.arange(at, at + count)
        place = heard + ahead(heard, one_way)
        whole = place.astype(np.int64)
        part = (place - whole).astype(np.float32)
        reference = (1 - part) * ref[whole % ref.size] + part * ref[(whole + 1) % ref.size]
        yield mic[heard % mic.size], reference


def from_file(minutes: float, engine: str, slices: int, one_way: bool = False) -> dict:
    """So many minutes of audio through the whole path as fast as it goes."""
    ego, yardstick = EgoFilter(DEMO / "profile.npz", engine), EgoFilter(engine="bypass")
    total, done, out, took, bypassed, parts = round(60 * minutes * SAMPLE_RATE), 0, 0, [], [], []
    not_finite = 0
    for number, (mic, ref) in enumerate(blocks(total, one_way)):
        start = time.thread_time()
        finished = ego.process(mic, ref)
        took.append(1000 * (time.thread_time() - start))
        if number % 10 == 0:
            start = time.thread_time()
            yardstick.process(mic, ref)
            bypassed.append(1000 * (time.thread_time() - start))
        ego.events()
        out, done = out + finished.size, done + mic.size
        not_finite += finished.size - int(np.count_nonzero(np.isfinite(finished)))
        if done * slices // total > len(parts):
            parts.append(
                Slice(
                    done / SAMPLE_RATE,
                    memory_mb(),
                    None,
                    *percentiles(took, 50, 99).values(),
                    float(np.median(bypassed)),
                )
            )
            took.clear()
            bypassed.clear()
    out += ego.flush().size
    linear = ego.stats()["linear_stage"]
    return {
        "kind": "file",
        "engine": ego.engine_name,
        "one_way": one_way,
        "samples_in": done,
        "samples_out": out,
        "lost": 0,
        "not_finite": not_finite,
        "diverged": linear["diverged"] if linear else 0,
        "slices": [asdict(part) for part in parts],
    }


def live(minutes: float, engine: str, slices: int) -> dict:
    """So many minutes of `edgefilter run` between virtual devices, which players feed with the conversation."""
    with virtual_sound.server() as server, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seconds = 60 * minutes
        players = [
            _play(server, sink, recording, seconds, folder)
            for sink, recording in (("robot", "reference"), ("robot_mic", "mic"))
        ]
        command = [
            sys.executable,
            "-m",
            "edgefilter.cli",
            "run",
            "--input",
            "mic",
            "--profile",
            str(DEMO / "profile.npz"),
            "--engine",
            engine,
        ]
        command += [
            "--output",
            str(folder / "out.wav"),
            "--json",
            str(folder / "stats.json"),
            "--seconds",
            str(seconds),
            "--quiet",
        ]
        run = subprocess.Popen(command, env=server.environment, stderr=subprocess.PIPE, text=True)
        began, parts, most = time.monotonic(), [], 0.0
        while run.poll() is None:
            time.sleep(min(1.0, seconds / slices / 2))
            elapsed, most = time.monotonic() - began, max(most, children_mb(run.pid))
            if elapsed * slices / seconds > len(parts) + 1 and run.poll() is None:
                parts.append(Slice(elapsed, memory_mb(run.pid), most))
                most = 0.0
        for player in players:
            player.kill()
            player.wait()
        if run.returncode:
            raise SystemExit(f"{' '.join(command)} failed: {run.stderr.read()}")
        stats = json.loads((folder / "stats.json").read_text())
    found = {
        "kind": "live",
        "engine": stats["engine"],
        "samples_in": stats["samples_in"],
        "samples_out": stats["samples_out"],
    }
    found |= {"lost": stats["samples_lost"], "source": stats["source"], "deadline": stats["deadline"]}
    return {**found, "slices": [asdict(part) for part in parts]}


def _play(server: virtual_sound.Server, sink: str, recording: str, seconds: float, folder: Path) -> subprocess.Popen:
    samples = soundfile.read(DEMO / f"{recording}.flac", dtype="int16")[0]
    path = folder / f"{sink}.wav"
    with soundfile.SoundFile(path, "w", SAMPLE_RATE, 1, "PCM_16") as file:
        for _ in range(int((seconds + 30) * SAMPLE_RATE / samples.size) + 1):
            file.write(samples)
    return subprocess.Popen(["paplay", "-d", sink, str(path)], env=server.environment)


def judge(result: dict) -> list[str]:
    """What drifted, in words; empty where nothing did."""
    troubles = []
    if result["samples_in"] != result["samples_out"]:
        troubles.append(f"{result['samples_in']} samples in, {result['samples_out']} out")
    if result["lost"]:
        troubles.append(f"{result['lost']} samples lost")
    if result.get("not_finite"):
        troubles.append(f"{result['not_finite']} samples are no numbers")
    if result.get("diverged"):
        troubles.append(f"the canceller diverged {result['diverged']} times")
    settled = _settled(result["slices"], SETTLING_S)
    result["memory_growth_mb"] = settled[-1]["memory_mb"] - settled[0]["memory_mb"]
    if result["memory_growth_mb"] > GROWTH_MB:
        troubles.append(f"memory grew by {result['memory_growth_mb']:.1f} MB")
    learning = _settled(result["slices"], LEARNING_S) if result["kind"] == "live" else []
    earlier, later = (
        max((part["learner_mb"] for part in half), default=None)
        for half in (learning[: len(learning) // 2], learning[len(learning) // 2 :])
    )
    result["learner_growth_mb"] = None if earlier is None or later is None else later - earlier
    if (result["learner_growth_mb"] or 0.0) > LEARNER_GROWTH_MB:
        troubles.append(f"the learner's memory grew by {result['learner_growth_mb']:.1f} MB")
    if result["kind"] == "file":
        half = len(settled) // 2
        first, second = (_over_bypass(parts) for parts in (settled[:half], settled[half:]))
        result["slower"] = second / first
        if second > SLOWER * first:
            troubles.append(
                f"a block took {first:.1f} times as long as a bypassed one in the first half and "
                f"{second:.1f} times in the second"
            )
    return troubles


def _settled(parts: list[dict], least_s: float) -> list[dict]:
    """The slices behind the warm-up."""
    after = max(0.1 * parts[-1]["seconds"], least_s)
    return [part for part in parts if part["seconds"] >= after]


def _over_bypass(parts: list[dict]) -> float:
    """A block's time over a bypassed one's.

    The mean, since a slice in which the robot is mostly silent costs two thirds of another; of the bypassed block,
    which costs the same whatever is heard, the median.
    """
    return float(np.mean([part["p50_ms"] for part in parts]) / np.median([part["bypass_ms"] for part in parts]))


def markdown(result: dict, name: str) -> str:
    """The page below its title; name: of the picture beside it, without suffix."""
    lines = [f"Load average at the end {result['load_average']:.1f}.", ""]
    lines += [f"{result['samples_in']} samples in, {result['samples_out']} out, {result['lost']} lost;"]
    lines += [f"memory grew by {result['memory_growth_mb']:+.2f} MB after the warm-up;"]
    if result["learner_growth_mb"] is not None:
        lines += [
            f"the learner's most by {result['learner_growth_mb']:+.1f} MB from the first half to the second, after its own;"
        ]
    if result["kind"] == "file":
        lines += [
            f"against a bypassed one, a block took {result['slower']:.2f} times as long in the second half as in "
            "the first."
        ]
    else:
        deadline = result["deadline"]
        lines += [
            f"{deadline['missed_deadlines']} of {deadline['hops']} hops missed their deadline, "
            f"p99 {deadline['compute']['p99_ms']:.1f} ms;"
        ]
        lines += [
            f"{deadline['steps']} steps down or up between engines to keep to {deadline['budget_ms']:g} ms, "
            "the engine above is the last."
        ]
    lines += ["", f"Verdict: {'; '.join(result['troubles']) or 'nothing drifted'}.", ""]
    cells = []
    for part in result["slices"]:
        times = ["" if part[key] is None else f"{part[key]:.3f}" for key in ("p50_ms", "p99_ms", "bypass_ms")]
        learner = "" if part["learner_mb"] is None else f"{part['learner_mb']:.1f}"
        cells.append([f"{part['seconds'] / 60:.1f}", f"{part['memory_mb']:.1f}", learner, *times])
    head = ["minute", "memory MB", "learner's MB", "p50", "p99", "bypassed, ms per 20 ms block"]
    lines += results_writer.table(head, cells)
    return "\n".join([*lines, "", f"![memory and time]({name}.png)", ""])


def title(result: dict) -> str:
    """How long, of what, how."""
    minutes = result["samples_in"] / SAMPLE_RATE / 60
    pace = "live" if result["kind"] == "live" else "faster than real time"
    beyond = ", a lag that grows all the time" if result.get("one_way") else ""
    return f"Soak: {minutes:.0f} minutes of `{result['engine']}`, {pace}{beyond}"


def draw(result: dict, output: Path) -> None:
    """Memory over the run, and beside it the learner's, or where blocks were timed their median over a bypassed one's."""
    parts = result["slices"]
    figure, axes = picture.panels(1, 2, (10, 3.5))
    minutes = [part["seconds"] / 60 for part in parts]
    if result["kind"] == "file":
        beside = "median block over a bypassed one", [part["p50_ms"] / part["bypass_ms"] for part in parts]
    else:
        beside = "the learner's memory, MB", [part["learner_mb"] for part in parts]
    curves = [("resident memory, MB", [part["memory_mb"] for part in parts]), beside]
    for axis, (name, values) in zip(axes, curves, strict=True):
        axis.plot(minutes, values, "o-")
        axis.set(title=name, xlabel="minutes", ylim=(0, 1.2 * max(values)))
    picture.save(figure, output)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--minutes", type=float, default=60.0, help="of audio, faster than real time (default: %(default)s)"
    )
    parser.add_argument("--live", type=float, metavar="MINUTES", help="run live on a virtual device instead")
    parser.add_argument("--one-way", action="store_true", help="the reference's clock is fast all the time")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--slices", type=int, default=20)
    parser.add_argument("--output", type=Path, help="without suffix; .json, .md and .png are written")
    args = parser.parse_args()
    made_with = results_writer.stamp({"DEMO": [DEMO]}, [args.engine])
    result = (
        live(args.live, args.engine, args.slices)
        if args.live
        else from_file(args.minutes, args.engine, args.slices, args.one_way)
    )
    result["load_average"] = os.getloadavg()[0]
    result["troubles"] = judge(result)
    page = markdown(result, args.output.name if args.output else "soak")
    if args.output:
        draw(result, args.output)
    print(results_writer.write(args.output, made_with, title(result), page, result))
    return 1 if result["troubles"] else 0


if __name__ == "__main__":
    sys.exit(main())
