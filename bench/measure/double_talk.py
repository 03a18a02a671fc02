"""Alignment while a human talks from the first second: utterances found, jumps that are none, delay errors.

Simulated and real.

    python -m bench.measure.double_talk --voices robot/val --speech human/val --real real --output bench/results/double_talk

Simulated: two utterances of 6 s, each with its own lag and no jump within, at every level of the echo over the human
(LEVELS) and every drift (DRIFTS), with a profile and without; rooms and fan as in bench/measure/alignment.py. Real:
recordings of one device whose lag is constant, of which nothing is known before, so that whatever moves the delay there
is an error. About 3 minutes on one core.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import soundfile as sf

from bench import results_writer
from bench.measure.alignment import CLOSE, HOP, Corpus, aligner
from bench.simulate.alignment_scene import RATE, DoubleTalk, double_talk, run
from edgefilter.alignment.aligner import Aligner

LEVELS = (26, 10, 0, -5, -10)
"""dB of the echo over the human."""
DRIFTS = (0, 40, -40, 80, -80, 150, -150, 300, -300)
"""ppm."""
SOON = 2 * RATE
"""Samples of an utterance after which its delay has to be known."""
AFTER = (0.5, 1, 2, 4)
"""Seconds of an utterance after which the delay error is reported."""


@dataclass
class Found:
    """What became of one utterance.

    soon: within 1 ms after SOON; stays: and from there to its end. jumps: switches of the delay by the tracker, of
    which all are false. lost: switches to a place more than 1 ms from the truth. errors: samples, AFTER so many
    seconds, nan while unknown.
    """

    level_db: float
    ppm: float
    profile: bool
    utterance: int
    soon: bool
    stays: bool
    jumps: int
    lost: int
    errors: list[float]


def judge(scene: DoubleTalk, tracker: Aligner, level_db: float, profile: bool) -> Iterator[Found]:
    """Run a scene and judge both of its utterances."""
    jumps, delays, switched = [], [], []
    for at in range(0, scene.ref.size - HOP + 1, HOP):
        aligned = tracker.step(scene.mic[at : at + HOP], scene.ref[at : at + HOP])
        delays.append(aligned.delay)
        switched.append(aligned.realigned)
        jumps.append(tracker.stats()["jumps"])
    error = np.abs(np.array(delays) - scene.truth[HOP - 1 :: HOP][: len(delays)])
    before = np.concatenate(([np.nan], delays[:-1]))
    moved = np.array(switched) & ~(np.abs(np.array(delays) - before) < 1.0)
    for number, (begin, end) in enumerate(scene.heard):
        first, stop = begin // HOP, min(end // HOP, len(delays) - 1)
        late = error[first + SOON // HOP : stop]
        errors = [float(error[first + int(s * RATE) // HOP]) for s in AFTER]
        lost = int(np.sum(moved[first:stop] & ~(error[first:stop] < CLOSE)))
        yield Found(
            level_db,
            scene.ppm,
            profile,
            number,
            bool(late[0] < CLOSE),
            bool(np.all(late < CLOSE)),
            jumps[stop] - jumps[first],
            lost,
            errors,
        )


def simulated(seed: int, repeats: int, voices: Corpus, speech: Corpus) -> list[Found]:
    """Every level and drift, `repeats` times, with a profile and without."""
    rows = []
    for number, (level, ppm) in enumerate((level, ppm) for level in LEVELS for ppm in DRIFTS):
        for k in range(repeats):
            rng = np.random.default_rng([seed, number, k])
            scene = double_talk(rng, [voices.draw(rng, 6) for _ in range(2)], speech.draw(rng, 18), level, ppm)
            for profile in (True, False):
                rows += judge(scene, aligner(rng, profile), level, profile)
    return rows


def real(folder: Path, patterns: list[str]) -> dict[str, dict]:
    """Jumps, switches and the delay's way in recordings NAME_mic, NAME_lpb, from nothing known."""
    found = {}
    for path in sorted(path for pattern in patterns for path in folder.glob(pattern)):
        mic, ref = (sf.read(p, dtype="float32")[0] for p in (path, path.with_name(path.name.replace("_mic", "_lpb"))))
        tracker = Aligner(HOP)
        delays = np.array([a.delay for a in run(tracker, mic, ref)])
        known = delays[~np.isnan(delays)]
        if not known.size:
            sys.exit(f"{path}: the robot was not found in it, expected a recording in which it is heard")
        about = float(np.median(known))
        deviation = np.abs(known - about)
        found[path.name.split("_mic")[0]] = {
            "jumps": tracker.stats()["jumps"], "realignments": tracker.stats()["realignments"], "delay": about,
            "off_share": float(np.mean(deviation > CLOSE)), "deviation": np.percentile(deviation, [50, 95, 100]).tolist(),
            "first_s": float(np.argmax(~np.isnan(delays)) * HOP / RATE), "ppm": tracker.stats()["ppm"],
        }  # fmt: skip
    return found


def summarise(rows: list[Found], recordings: dict[str, dict]) -> str:
    """Markdown tables."""
    seconds = ", ".join(f"{s:g}" for s in AFTER)
    head = ["", "echo over human, dB", "within 1 ms after 2 s", "and stays", "jumps", "switches to a wrong place"]
    head += [f"delay error p95 after {seconds} s, samples"]
    lines = ["| " + " | ".join(head) + " |", "| --- " * len(head) + "|"] if rows else []
    for profile in sorted({r.profile for r in rows}, reverse=True):
        for level in (*LEVELS, None):
            some = [r for r in rows if r.profile == profile and level in (r.level_db, None)]
            errors = np.nan_to_num(np.array([r.errors for r in some]), nan=9999.0)
            p95 = " / ".join(f"{e:.1f}" if e < 9999 else "none yet" for e in np.percentile(errors, 95, axis=0))
            name = f"{'' if profile else 'no '}profile"
            lines.append(f"| {name} | {'all' if level is None else level} | {sum(r.soon for r in some)} of {len(some)} | "
                         f"{sum(r.stays for r in some)} | {sum(r.jumps for r in some)} | {sum(r.lost for r in some)} | {p95} |")  # fmt: skip
    for ppm in sorted({abs(r.ppm) for r in rows}):
        some = [r for r in rows if abs(r.ppm) == ppm]
        lines.append(
            f"\n{ppm} ppm: {sum(r.stays for r in some)} of {len(some)} within 1 ms after 2 s and from there on,"
            f" {sum(r.jumps for r in some)} jumps."
        )
    if recordings:
        lines += ["\n| recording | jumps | realignments | delay, samples | further than 1 ms from it | deviation p50 / p95 / max | known after, s |",
                  "| --- | --- | --- | --- | --- | --- | --- |"]  # fmt: skip
    for name, r in recordings.items():
        way = " / ".join(f"{d:.1f}" for d in r["deviation"])
        lines.append(
            f"| {name} | {r['jumps']} | {r['realignments']} | {r['delay']:.1f} | {100 * r['off_share']:.1f} % | {way} |"
            f" {r['first_s']:.2f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--voices", type=Path, required=True, help="folder of the robot's utterances")
    parser.add_argument("--speech", type=Path, required=True, help="folder of humans")
    parser.add_argument("--real", type=Path, help="folder of recordings NAME_mic and NAME_lpb")
    parser.add_argument("--pattern", default=["*_mic.*"], nargs="+", help="which of them")
    parser.add_argument("--repeats", type=int, default=2, help="scenes of each level and drift")
    parser.add_argument("--seed", type=int, default=900000)
    parser.add_argument("--output", type=Path, default=Path("bench/results/double_talk"))
    options = parser.parse_args()
    made_with = results_writer.stamp(
        {"ROBOT": [options.voices], "HUMAN": [options.speech]}
        | ({"RECORDINGS": [options.real]} if options.real else {})
    )
    rows = (
        simulated(options.seed, options.repeats, Corpus(options.voices), Corpus(options.speech))
        if options.repeats
        else []
    )
    recordings = real(options.real, options.pattern) if options.real else {}
    if options.real and not recordings:
        sys.exit(
            f"{options.real} holds no {' or '.join(options.pattern)}, expected recordings NAME_mic beside NAME_lpb:"
            " check --real and --pattern"
        )
    content = {"seed": options.seed, "simulated": [asdict(r) for r in rows], "real": recordings}
    page = summarise(rows, recordings)
    print(results_writer.write(options.output, made_with, "Alignment while a human talks", page, content))


if __name__ == "__main__":
    main()
