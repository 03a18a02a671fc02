"""The long run: memory, time per hop and samples must not drift.

soak: so many minutes of audio faster than real time; hour: the same live on virtual devices, with the learner. The sound
is the bundled conversation over and over. In a soak the reference has a clock that is PPM fast for TURN_S and as much
slow for the next, so that the alignment has work to do for ever. Memory and processor time, per block and of the learner,
are read once in each of SLICES, the learner's memory each second, of which the slice has the most. The first tenth of the run,
a minute at least, is warm-up: a shorter run tells only which samples were lost. Exit code 1 where something drifted.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import soundfile

from bench import provenance, results
from bench.live import virtual_sound
from bench.live.virtual_sound import children, memory_mb, processor_s
from bench.metrics import percentiles
from bench.recordings import read
from edgefilter import EgoFilter
from edgefilter.errors import UsageError
from edgefilter.filter.budget import DEMO
from edgefilter.types import SAMPLE_RATE

SLICES = 20
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
WARM_UP_S = 60.0
"""Least warm-up. The learner's first fits need the more memory, the more was recorded by then; and on a busy machine the process
itself still grew by 3.3 MB between the 15th and the 20th second."""
SLOWER = 1.3
"""Most growth of a block's processor time over that of a bypassed block, second half over first. A shared machine
changes its speed by more than that, and the bypass with it."""


def run(options: argparse.Namespace) -> str:
    engine = options.engine or "auto"
    # "auto" is crnn wherever that is fast enough
    made_with = provenance.stamp({"DEMO": [DEMO]}, [provenance.TIMED, options.engine or "crnn"])
    part, is_live = options.part, options.part == "hour"
    found = live(options.minutes, engine) if is_live else from_file(options.minutes, engine)
    found["load_average"] = os.getloadavg()[0]
    troubles, slices = drifts(found), found["slices"]
    minutes = found["samples_in"] / SAMPLE_RATE / 60
    title = f"{minutes:.0f} minutes of `{found['engine']}`, {'live' if is_live else 'faster than real time'}"
    facts = [(key.replace("_", " "), value) for key, value in found.items() if isinstance(value, int | float | str)]
    if deadline := found.get("deadline"):
        facts += late(deadline).items()
    keys = [key for key in slices[0] if key != "seconds"]
    columns = [("minute", 1), *((key.replace("_", " "), 3 if key.endswith("_ms") else 1) for key in keys)]
    rows = [[one["seconds"] / 60, *(one[key] for key in keys)] for one in slices]
    at, *values = zip(*rows)
    lines = {key: (at, of) for key, of in zip(keys, values)}
    curves = [results.panel(key.replace("_", " "), "minutes", "", {key: line}, "o-") for key, line in lines.items()]
    verdict = f"Verdict: {'; '.join(troubles) or 'nothing drifted'}"
    tables = [results.table(part, verdict, ["", ""], facts), results.table(f"{part}-slices", "By time", columns, rows)]
    page = results.write(options.output, part, title, made_with, tables, [results.plot(part, curves)], **found)
    if troubles:
        raise UsageError("; ".join(troubles))
    return page


def late(deadline: Mapping) -> dict[str, object]:
    """What `edgefilter run` counts: hops that took too long, steps to another engine, what a hop took."""
    took = deadline["compute"]
    return {
        "hops late": f"{deadline['missed_deadlines']} of {deadline['hops']}",
        "steps between engines": deadline["steps"],
        "ms a hop, p50 / p99": f"{took['p50_ms']:.1f} / {took['p99_ms']:.1f}",
    }


def ahead(at: np.ndarray) -> np.ndarray:
    """Samples that the reference's clock has gained at these samples."""
    turn = round(TURN_S * SAMPLE_RATE)
    return PPM * 1e-6 * (turn - np.abs(at % (2 * turn) - turn))


def blocks(total: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """So many samples of the conversation in a loop, the reference on its own clock."""
    mic, ref = (read(DEMO / f"{name}.flac") for name in ("mic", "reference"))
    for start in range(0, total, BLOCK):
        at = np.arange(start, min(start + BLOCK, total))
        place = at + ahead(at)
        whole = place.astype(np.int64)
        part = (place - whole).astype(np.float32)
        yield mic[at % mic.size], (1 - part) * ref[whole % ref.size] + part * ref[(whole + 1) % ref.size]


def from_file(minutes: float, engine: str) -> dict:
    """So many minutes of audio through the whole path as fast as it goes."""
    ego, yardstick = EgoFilter(DEMO / "profile.npz", engine=engine), EgoFilter(engine="bypass")
    total, done, out, not_finite = round(60 * minutes * SAMPLE_RATE), 0, 0, 0
    took, bypassed, slices = [], [], []
    for number, (mic, ref) in enumerate(blocks(total)):
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
        if done * SLICES // total > len(slices):
            times = percentiles(took, 50, 99)
            slices.append({"seconds": done / SAMPLE_RATE, "memory_mb": memory_mb(), "p50_ms": times["p50"],
                           "p99_ms": times["p99"], "bypass_ms": float(np.median(bypassed))})  # fmt: skip
            took.clear()
            bypassed.clear()
    out += ego.flush().size
    diverged = (ego.stats()["linear_stage"] or {}).get("diverged", 0)
    counts = {"samples_in": done, "samples_out": out, "lost": 0, "not_finite": not_finite, "diverged": diverged}
    return {"engine": ego.engine_name, **counts, "slices": slices}


def live(minutes: float, engine: str) -> dict:
    """So many minutes of `edgefilter run` between virtual devices, which players feed with the conversation."""
    seconds = 60 * minutes
    with virtual_sound.server() as server, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        players = [_play(server, sink, DEMO / f"{sound}.flac", seconds, folder)
                   for sink, sound in (("robot", "reference"), ("robot_mic", "mic"))]  # fmt: skip
        command = [sys.executable, "-m", "edgefilter.cli", "run", "--input", "mic", "--engine", engine, "--quiet"]
        command += ["--profile", DEMO / "profile.npz", "--output", folder / "out.wav", "--json", folder / "stats.json"]
        command += ["--seconds", seconds]
        process = subprocess.Popen(list(map(str, command)), env=server.environment, stderr=subprocess.PIPE, text=True)
        began, slices, most, before, spent = time.monotonic(), [], 0.0, 0.0, 0.0
        while process.poll() is None:
            time.sleep(min(1.0, seconds / SLICES / 2))
            elapsed, learners = time.monotonic() - began, children(process.pid)
            most = max(most, sum(map(memory_mb, learners)))
            if elapsed * SLICES / seconds > len(slices) + 1 and process.poll() is None:
                took = sum(map(processor_s, learners)) - spent
                slices.append({"seconds": elapsed, "memory_mb": memory_mb(process.pid), "learner_mb": most,
                               "learner_cpu_s_a_minute": 60 * took / (elapsed - before)})  # fmt: skip
                most, before, spent = 0.0, elapsed, spent + took
        for player in players:
            player.kill()
            player.wait()
        if process.returncode:
            raise UsageError(f"edgefilter run failed: {process.stderr.read()}")
        stats = json.loads((folder / "stats.json").read_text())
    found = {key: stats[key] for key in ("engine", "samples_in", "samples_out", "source", "deadline")}
    learner_cpu_s = (stats["learning"] or {}).get("cpu_s", 0.0)  # with one core nothing is learned
    return {**found, "learner_cpu_s_a_minute": learner_cpu_s / minutes, "lost": stats["samples_lost"], "slices": slices}


def _play(server: virtual_sound.Server, sink: str, sound: Path, seconds: float, folder: Path) -> subprocess.Popen:
    samples, path = soundfile.read(sound, dtype="int16")[0], folder / f"{sink}.wav"
    with soundfile.SoundFile(path, "w", SAMPLE_RATE, 1, "PCM_16") as file:
        for _ in range(int((seconds + 30) * SAMPLE_RATE / samples.size) + 1):
            file.write(samples)
    return subprocess.Popen(["paplay", "-d", sink, str(path)], env=server.environment)


def drifts(found: dict) -> list[str]:
    """What drifted, in words; empty where nothing did. Growth is noted in what was found."""
    troubles = []
    if found["samples_in"] != found["samples_out"]:
        troubles.append(f"{found['samples_in']} samples in, {found['samples_out']} out")
    for key, what in (("lost", "samples lost"), ("not_finite", "samples are no numbers"), ("diverged", "divergences")):
        if found.get(key):
            troubles.append(f"{found[key]} {what}")
    if len(settled := _settled(found["slices"])) < 2:
        return troubles
    found["memory_growth_mb"] = settled[-1]["memory_mb"] - settled[0]["memory_mb"]
    if found["memory_growth_mb"] > GROWTH_MB:
        troubles.append(f"memory grew by {found['memory_growth_mb']:.1f} MB")
    if "learner_mb" in settled[0]:
        first, second = (max(one["learner_mb"] for one in half) for half in _halves(settled))
        found["learner_growth_mb"] = second - first
        cpu_s = float(np.mean([one["learner_cpu_s_a_minute"] for one in settled]))
        found["learner_cpu_s_a_minute_once_settled"] = cpu_s
        if second - first > LEARNER_GROWTH_MB:
            troubles.append(f"the learner's memory grew by {second - first:.1f} MB")
    if "bypass_ms" in settled[0]:
        # means, since a slice without speech takes two thirds of the time of one with speech; a bypassed block always takes the same
        took, bypass = ([[one[key] for one in half] for half in _halves(settled)] for key in ("p50_ms", "bypass_ms"))
        first, second = (float(np.mean(ours) / np.median(its)) for ours, its in zip(took, bypass))
        found["slower"] = second / first
        if second > SLOWER * first:
            said = f"a block took {first:.1f} times as long as a bypassed one"
            troubles.append(f"{said}, in the second half {second:.1f} times")
    return troubles


def _settled(slices: Sequence[Mapping]) -> Sequence[Mapping]:
    after = max(0.1 * slices[-1]["seconds"], WARM_UP_S)
    return [one for one in slices if one["seconds"] >= after]


def _halves(slices: Sequence[Mapping]) -> tuple[Sequence[Mapping], Sequence[Mapping]]:
    return slices[: len(slices) // 2], slices[len(slices) // 2 :]
