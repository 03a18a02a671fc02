"""Judge the diagnosis on recordings with hidden effects: calibrate from each case's sweep, diagnose, count.

    python -m bench.measure.hidden_effects DIR [DIR ...] [--limit N] [--jobs 2] [--json] [--output PATH]

A folder holds cases as bench.simulate.hidden_cases and bench.simulate.wild write them: sweep_ref, sweep_mic, fan_only,
ref, mic (FLAC), truth.json (effects, raw, strength, and `also`: other names that are right). Instead of truth.json files
it may hold one seals.json: per case a salt and the sha256 of salt + ":" + case + ":" + label. Then the diagnosis's own
answer is hashed, and nothing else: a hit is the exact label (effects sorted and joined by "+", none, unknown). Prints
and writes Markdown and JSON: counts with 95 % Wilson intervals, excess before and after, the confusion matrix, each
miss.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import soundfile as sf
from tqdm import tqdm

from bench import results_writer
from bench.measure import hidden_scores
from bench.measure.hidden_scores import Outcome
from edgefilter.calibration.calibrate import calibrate
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.errors import UsageError

SIGNALS = ("sweep_ref", "sweep_mic", "fan_only", "ref", "mic")


def find_cases(folder: Path, limit: int | None) -> list[Path]:
    """The case folders, at most limit of them, evenly spread. Raises UsageError where there is none."""
    found = sorted(path.parent for path in folder.glob("*/mic.flac"))
    if not found:
        raise UsageError(f"{folder} holds no */mic.flac, expected cases: make some with bench.simulate.hidden_cases")
    if limit and limit < len(found):
        found = [found[i] for i in np.linspace(0, len(found) - 1, limit).astype(int)]
    return found


def judge(case: Path, truth: dict | None) -> Outcome:
    """Diagnose one case; an error of the product is its answer."""
    signals = {name: sf.read(case / f"{name}.flac", dtype="float32")[0] for name in SIGNALS}
    known = {"effects": [], "raw": [], "strength": "sealed"} if truth is None else {"raw": truth["effects"]} | truth
    started = time.process_time()
    said: dict = {
        "verdict": "error",
        "named": (),
        "before_db": (),
        "after_db": (),
        "share": (),
        "excess_db": np.nan,
        "remaining_db": np.nan,
    }
    try:
        profile = calibrate(*(signals[name] for name in SIGNALS[:3]))
        found = diagnose(profile, signals["mic"], signals["ref"])
        said |= {
            "verdict": found.verdict,
            "named": tuple(finding.effect for finding in found.ranking),
            "remaining_db": found.remaining_db,
        }
        said |= {
            "before_db": tuple(f.excess_before_db for f in found.ranking),
            "after_db": tuple(f.excess_after_db for f in found.ranking),
        }
        said |= {
            "share": tuple(f.share for f in found.ranking),
            "excess_db": found.comparison.excess_db,
            "evidence": found.evidence,
        }
    except Exception as error:  # whatever it is, it is a miss of this case, and the other cases are scored
        said["evidence"] = f"{type(error).__name__}: {error}"
    seconds = time.process_time() - started
    return Outcome(
        case.name,
        tuple(sorted(known["effects"])),
        tuple(known["raw"]),
        known["strength"],
        **said,
        seconds=seconds,
        also=tuple(known.get("also", ())),
    )


def check_seal(outcome: Outcome, seal: dict) -> Outcome:
    """The outcome of a sealed case with sealed_hit set, from the hash of its own answer."""
    text = f"{seal['salt']}:{outcome.case}:{outcome.label}"
    return replace(outcome, sealed_hit=hashlib.sha256(text.encode()).hexdigest() == seal["sha256"])


def outcome(case: Path, seal: dict | None) -> Outcome:
    """What came of one case, by its truth or its seal."""
    if seal is not None:
        return check_seal(judge(case, None), seal)
    return judge(case, json.loads((case / "truth.json").read_text(encoding="utf-8")))


def run(folder: Path, limit: int | None, jobs: int) -> list[Outcome]:
    """Every case of a folder. Raises UsageError where a case has neither truth nor seal."""
    path = folder / "seals.json"
    seals = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    cases = find_cases(folder, limit)
    for case in cases:
        if not (case / "truth.json").exists() and case.name not in seals:
            raise UsageError(f"{case} has neither a truth.json nor an entry in {path}; expected one of them")
    sealed = [None if (case / "truth.json").exists() else seals[case.name] for case in cases]
    with ProcessPoolExecutor(jobs) as pool:
        return list(
            tqdm(
                pool.map(outcome, cases, sealed),
                total=len(cases),
                unit="case",
                desc=str(folder),
                disable=not sys.stderr.isatty(),
            )
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--limit", type=int, metavar="N", help="at most N cases of each folder, evenly spread")
    parser.add_argument(
        "--jobs",
        type=int,
        default=1,
        help="cases at a time; with more than one the seconds per case are not those of a free core",
    )
    parser.add_argument("--json", action="store_true", help="print the figures as JSON instead of Markdown")
    parser.add_argument("--output", type=Path, metavar="PATH", help="also write PATH.md and PATH.json")
    options = parser.parse_args()
    try:
        made_with = results_writer.stamp({"CASES": options.folders})
        results = {folder.resolve().name: run(folder, options.limit, options.jobs) for folder in options.folders}
    except (UsageError, OSError) as error:
        print(f"hidden_effects: {error}", file=sys.stderr)
        return 1
    summaries = {name: hidden_scores.summarise(outcomes) for name, outcomes in results.items()}
    sections = (hidden_scores.markdown(name, results[name], summaries[name]) for name in results)
    page = hidden_scores.glance(summaries) + "\n".join(sections)
    content = {
        "summary": summaries,
        "cases": {name: [asdict(outcome) for outcome in found] for name, found in results.items()},
    }
    text = results_writer.write(options.output, made_with, "Hidden effects: what the diagnosis says", page, content)
    print(results_writer.to_json({"stamp": made_with, **content}) if options.json else text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
