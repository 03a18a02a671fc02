"""Measure alignment: lag errors, time to align, drift, jumps, false realignments, half an hour of speech, cost per hop.

    python -m bench.measure.alignment --voices ROBOT/val --speech HUMAN/val --output bench/results/alignment

--voices and --speech are folders of recordings (16 kHz mono; the robot's voice, and humans). Rooms, clocks and fan are
simulated with a known truth (bench/simulate/alignment_scene.py). Writes OUTPUT.json, OUTPUT.md and OUTPUT.png. About 6
minutes on one core. --seed says which scenes are drawn: thresholds were set on seeds below 100000, so that a report
takes another. --only-cost times a few conversations on a machine left alone, 10 s, and puts the cost, with a stamp of
its own, into an OUTPUT.json that is there.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import soundfile as sf
from scipy import signal

from bench import results_writer
from bench.measure import alignment_report
from bench.measure.alignment_report import CLOSE, HOP, JUMPS
from bench.measure.intervals import percentiles
from bench.simulate.alignment_scene import HEAD, RATE, fan, hear, known_path, room, run
from edgefilter.alignment.aligner import Aligner

TIMED = 6
"""Conversations whose hops are timed, with a profile and without."""


class Corpus:
    """Recordings of a folder, drawn at random, level 0.05 rms."""

    def __init__(self, folder: Path) -> None:
        self.files = sorted(p for p in folder.rglob("*") if p.suffix in (".flac", ".ogg", ".wav"))
        if not self.files:
            sys.exit(f"{folder} holds no recordings, expected .flac, .ogg or .wav files: check --voices and --speech")

    def draw(self, rng: np.random.Generator, seconds: float | None = None) -> np.ndarray:
        parts: list[np.ndarray] = []
        while not parts or (seconds and sum(p.size for p in parts) < seconds * RATE):
            x = sf.read(self.files[rng.integers(len(self.files))], dtype="float32")[0]
            parts.append(x)
        x = np.concatenate(parts)[: int(seconds * RATE) if seconds else None]
        return 0.05 * x / (np.std(x) + 1e-9)


def aligner(rng: np.random.Generator, with_profile: bool) -> Aligner:
    return Aligner(HOP, known_path(room(rng, 0.25)) if with_profile else None)


def onset(x: np.ndarray) -> int:
    return int(np.argmax(np.abs(x) > 0.02 * np.abs(x).max()))


def conversation(rng: np.random.Generator, voices: Corpus, speech: Corpus) -> dict:
    """Three utterances with a lag each: RT60 0.2-0.75 s, clocks up to 300 ppm apart, a human 0-20 dB lower."""
    parts, at, starts = [np.zeros(RATE // 2, np.float32)], RATE // 2, []
    for _ in range(3):
        x, pause = voices.draw(rng)[: 5 * RATE], np.zeros(int(rng.uniform(1.8, 2.5) * RATE), np.float32)
        starts.append(at + onset(x))
        parts += [x, pause]
        at += x.size + pause.size
    ref = np.concatenate(parts)
    lags, ppm = rng.uniform(0, 1.5 * RATE, 3).round(), rng.uniform(-300, 300)
    rt60 = rng.uniform(0.2, 0.75)
    mic, truth = hear(ref, [(s - 2000, lag) for s, lag in zip(starts, lags, strict=True)], room(rng, rt60), ppm)
    level = rng.uniform(-20, 0)
    human = speech.draw(rng, mic.size / RATE)
    human = np.pad(human, (0, mic.size - human.size)) * np.std(mic) / np.std(human) * 10 ** (level / 20)
    mic = (mic + human + fan(rng, mic.size, 0.03 * np.std(mic))).astype(np.float32)
    return {
        "ref": ref,
        "mic": mic,
        "truth": truth,
        "starts": starts,
        "lags": lags,
        "ppm": ppm,
        "rt60": rt60,
        "human_db": level,
    }


def judge_conversation(scene: dict, hops: list) -> list[dict]:
    error = np.array([a.delay for a in hops]) - scene["truth"][HOP - 1 :: HOP][: len(hops)]
    rows = []
    for i, (start, lag) in enumerate(zip(scene["starts"], scene["lags"], strict=True)):
        first = int(start + lag + HEAD) // HOP
        stop = min(first + int(2.5 * RATE) // HOP, len(hops))
        good = np.abs(error[first:stop]) < CLOSE
        bad = np.flatnonzero(~good)
        aligned = 0 if bad.size == 0 else bad[-1] + 1
        at_300 = error[first + int(0.3 * RATE) // HOP]
        rows.append({"utterance": i, "time_ms": float(aligned * HOP / 16) if aligned < good.size else None,
                     "error_300ms": None if np.isnan(at_300) else float(at_300), "final_error": float(error[stop - 1]),
                     "rt60": scene["rt60"], "human_db": scene["human_db"]})  # fmt: skip
    return rows


def lag_trials(seed: int, count: int, voices: Corpus, speech: Corpus, costs: list) -> dict:
    out = {}
    for with_profile in (True, False):
        rows, drift = [], []
        for i in range(count):
            rng = np.random.default_rng(seed + i)
            scene = conversation(rng, voices, speech)
            a, hops = aligner(rng, with_profile), []
            for at in range(0, scene["ref"].size - HOP + 1, HOP):
                begin = time.perf_counter()
                hops.append(a.step(scene["mic"][at : at + HOP], scene["ref"][at : at + HOP]))
                costs.append(time.perf_counter() - begin)
            rows += judge_conversation(scene, hops)
            known = np.flatnonzero([x.delay == x.delay for x in hops])
            if known.size:
                drift.append(np.abs(np.array([x.ppm for x in hops[known[0] : known[0] + 600]]) - scene["ppm"]))
        length = min(d.size for d in drift)
        out["profile" if with_profile else "no profile"] = {
            "rows": rows,
            "drift": np.percentile([d[:length] for d in drift], [50, 95], axis=0).tolist(),
        }
    return out


def cost_trials(seed: int, voices: Corpus, speech: Corpus) -> dict:
    """Milliseconds per hop over TIMED conversations with a profile and without, the first tenth left out.

    Others: processes running beside (Linux).
    """
    costs, running = [], [Path("/proc/loadavg").read_text().split()[3]]
    lag_trials(seed, TIMED, voices, speech, costs)
    running.append(Path("/proc/loadavg").read_text().split()[3])
    ms = 1e3 * np.array(costs[len(costs) // 10 :])
    others = max(int(count.split("/")[0]) - 1 for count in running)
    return {"ms": {**percentiles(ms, 50, 95, 99, 100), "mean": float(ms.mean())}, "others": others}


def jump_trials(seed: int, repeats: int, voices: Corpus) -> list[dict]:
    """Jumps of 2 to 500 samples, and of 1500, beyond the tracker's reach; longer and shorter delays in turn."""
    rows = []
    for size in JUMPS:
        for k in range(2 * repeats):
            jump, rng = size * (-1) ** k, np.random.default_rng(seed + 1000 + 100 * size + k)
            ref = np.concatenate((np.zeros(4000, np.float32), voices.draw(rng, 9)))
            mic, truth = hear(ref, [(0, 7000.0)], room(rng, rng.uniform(0.2, 0.75)), 80.0)
            at = int(rng.uniform(5, 6) * RATE)
            cut = np.s_[at : at + size]
            mic = np.delete(mic, cut) if jump < 0 else np.insert(mic, at, np.zeros(size, np.float32))
            truth = np.delete(truth, cut) if jump < 0 else np.insert(truth, at, np.full(size, np.nan))
            truth[at:] += jump
            hops = run(aligner(rng, True), mic + fan(rng, mic.size), ref)
            error = np.array([a.delay for a in hops]) - truth[HOP - 1 :: HOP][: len(hops)]
            first = at // HOP + 1
            bad = np.flatnonzero(~(np.abs(error[first : first + 125]) < 0.7))
            healed = 0 if bad.size == 0 else int(bad[-1] + 1)
            frames = ref[max(at - 7000, 0) :][: healed * HOP].reshape(-1, HOP)
            speaking = int(np.sum(np.mean(frames**2, axis=1) > 1e-2 * np.mean(ref**2)))
            rows.append(
                {"jump": jump, "ms": healed * HOP / 16, "ms_of_speech": speaking * HOP / 16, "healed": healed < 125}
            )
    return rows


def false_trials(seed: int, minutes: int, voices: Corpus, speech: Corpus) -> dict:
    """Realignments in `minutes` minutes each, every minute after the robot has spoken once."""
    counts = {}
    for name in ("silence", "human", "loud human", "noise", "unheard robot, silence", "unheard robot, human"):
        for with_profile in (True, False):
            found = sum(
                false_minute(np.random.default_rng(seed + 31 + i), name, with_profile, voices, speech)
                for i in range(minutes)
            )
            counts[f"{name}, {'' if with_profile else 'no '}profile"] = found
    return counts


def false_minute(rng: np.random.Generator, name: str, with_profile: bool, voices: Corpus, speech: Corpus) -> int:
    ref = np.concatenate((np.zeros(4000, np.float32), voices.draw(rng, 5), np.zeros(60 * RATE, np.float32)))
    mic = hear(ref, [(0, 9000.0)], room(rng, 0.6))[0]
    later = 7 * RATE
    if "human" in name:
        mic[later:] += (5.0 if "loud" in name else 1.0) * speech.draw(rng, (mic.size - later) / RATE)
    if name == "noise":
        mic[later:] += 0.1 * rng.standard_normal(mic.size - later).astype(np.float32)
    if "unheard" in name:
        for at in range(later, ref.size - 6 * RATE, 6 * RATE):
            ref[at : at + 4 * RATE] = voices.draw(rng, 4)
    hops = run(aligner(rng, with_profile), mic + fan(rng, mic.size), ref)
    return int(sum(a.realigned for a in hops[later // HOP :]))


def long_speech(seed: int, voices: Corpus, minutes: int, ppm: float = 100.0) -> dict:
    rng = np.random.default_rng(seed + 77)
    parts: list[np.ndarray] = [np.zeros(RATE, np.float32)]
    while sum(p.size for p in parts) < minutes * 60 * RATE:
        parts += [voices.draw(rng), np.zeros(int(rng.uniform(0.5, 2) * RATE), np.float32)]
    ref = np.concatenate(parts)[: minutes * 60 * RATE]
    heard = signal.oaconvolve(ref, room(rng, 0.5).astype(np.float32))[: ref.size]
    a, errors, ppms, realigned = aligner(rng, True), [], [], 0
    for start in range(0, ref.size, 30 * RATE):
        stop = min(start + 30 * RATE, ref.size)
        t, first = np.arange(start, stop), max(start - 40000, 0)
        delay = 14000 - ppm * 1e-6 * t
        fine = signal.resample_poly(heard[first:stop], 8, 1)
        mic = np.interp((t - delay - first) * 8, np.arange(fine.size), fine, left=0.0) + fan(rng, stop - start)
        hops = run(a, mic.astype(np.float32), ref[start:stop])
        realigned += sum(x.realigned for x in hops)
        errors += [x.delay - d for x, d in zip(hops, (delay + HEAD)[HOP - 1 :: HOP], strict=False)]
        ppms += [x.ppm for x in hops]
    e, p, minute, warm = np.array(errors), np.array(ppms) - ppm, int(60 * RATE / HOP), int(10 * RATE / HOP)
    spans = {"first minute (after 10 s)": slice(warm, minute), "last minute": slice(-minute, None)}
    rows = {n: {"rms_jitter": float(np.std(e[s])), "mean_error": float(np.mean(e[s])),
                "worst_error": float(np.max(np.abs(e[s] - np.mean(e[s])))),
                "rms_ppm_error": float(np.sqrt(np.mean(p[s] ** 2)))} for n, s in spans.items()}  # fmt: skip
    return {
        "parts": rows,
        "realigned": int(realigned),
        "error": e[:: max(e.size // 3000, 1)].tolist(),
        "ppm_error": p[:: max(p.size // 3000, 1)].tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--voices", type=Path, required=True)
    parser.add_argument("--speech", type=Path, required=True)
    parser.add_argument("--count", type=int, default=30, help="conversations of three utterances")
    parser.add_argument("--minutes", type=int, default=30, help="of drifting speech")
    parser.add_argument("--false-minutes", type=int, default=5, help="of each kind of sound that is not the robot")
    parser.add_argument("--repeats", type=int, default=3, help="jumps of each size and direction")
    parser.add_argument("--only-cost", action="store_true", help="measure the cost anew, keep the rest of OUTPUT.json")
    parser.add_argument("--seed", type=int, default=900000)
    parser.add_argument("--output", type=Path, default=Path("bench/results/alignment"))
    options = parser.parse_args()
    voices, speech = Corpus(options.voices), Corpus(options.speech)
    made_with = results_writer.stamp({"ROBOT": [options.voices], "HUMAN": [options.speech]})
    if options.only_cost:
        result = json.loads(options.output.with_suffix(".json").read_text(encoding="utf-8"))
        stamp_of_cost, made_with = (
            made_with,
            result.get("stamp") or sys.exit(f"{options.output}.json has no stamp: measure all of it anew"),
        )
    else:
        result = {"seed": options.seed, "lags": lag_trials(options.seed, options.count, voices, speech, [])}
        result["jumps"] = jump_trials(options.seed, options.repeats, voices)
        result["false"], result["false_minutes"] = (
            false_trials(options.seed, options.false_minutes, voices, speech),
            options.false_minutes,
        )
        result["long"], result["long_minutes"] = long_speech(options.seed, voices, options.minutes), options.minutes
        stamp_of_cost = made_with
    result["cost"] = {**cost_trials(options.seed, voices, speech), "stamp": stamp_of_cost}
    alignment_report.draw(result, options.output)
    print(results_writer.write(options.output, made_with, "Alignment", alignment_report.markdown(result), result))


if __name__ == "__main__":
    main()
