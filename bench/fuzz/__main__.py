"""Damaged files by the million: loaders refuse them in one line, and what they accept keeps the filter's promises.

    OMP_NUM_THREADS=1 python -m bench.fuzz --inputs 1000000 --minutes 60 --share 0.4 --output bench/results/fuzz

Each input is a real file damaged at random, a pure function of seed and number: `--start NUMBER --inputs 1` makes one
again. A find is a file that is not refused by one EdgefilterError of one line, that breaks a promise after it was taken,
or takes longer than PATIENCE_S. Where the process itself dies (a codec, onnxruntime) that is one as well, and another
process goes on behind it. Exit code 1 where there are finds.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench import results_writer
from bench.fuzz.targets import DEMO, NETWORKS, TARGETS
from bench.fuzz.worker import COLUMNS, MEMORY, PATIENCE_S, Counts, target_of, work


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=1_000_000, help="default: %(default)s")
    parser.add_argument("--start", type=int, default=0, metavar="NUMBER", help="of the first input")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after so many")
    parser.add_argument("--share", type=float, default=1.0, help="of one core, to leave the rest to others")
    parser.add_argument("--only", choices=[target.name for target in TARGETS], help="one loader alone")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the files that were finds")
    parser.add_argument("--output", type=Path, help="without suffix; .json and .md are written")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    return work(args) if args.worker else watch(args)


def watch(args: argparse.Namespace) -> int:
    """Run workers until all is done; one that dies is a find, and the next begins behind it."""
    made_with = results_writer.stamp({"DEMO": [DEMO], "NETWORKS": [NETWORKS]})
    began, at, end = time.monotonic(), args.start, args.start + args.inputs
    deaths = []
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as name:
        counts = Counts(Path(name))
        while at < end and (left := args.minutes - (time.monotonic() - began) / 60) > 0:
            options = [
                "--start",
                at,
                "--inputs",
                end - at,
                "--seed",
                args.seed,
                "--share",
                args.share,
                "--minutes",
                left,
            ]
            options += ["--worker", name, *(["--only", args.only] if args.only else [])]
            options += ["--keep", args.keep] if args.keep else []
            died = subprocess.call(
                [sys.executable, "-m", "bench.fuzz", *map(str, options)], env={**os.environ, "XDG_CACHE_HOME": name}
            )
            at = counts.number + 1
            if died:
                loader = target_of(args.seed, counts.number, args.only).name
                deaths.append({"number": counts.number, "loader": loader, "what": f"the process died ({died})"})
        finds = counts.finds() + deaths
        result = {"inputs": at - args.start, "seed": args.seed, "loaders": counts.table(), "finds": finds}
        result["seconds"] = time.monotonic() - began
    print(results_writer.write(args.output, made_with, f"{result['inputs']} damaged files", markdown(result), result))
    return 1 if finds else 0


def markdown(result: dict) -> str:
    """The page below its head."""
    rows = [(name, sum(row.values()), *row.values()) for name, row in result["loaders"].items()]
    lines = [
        "Real files of the demo and of the tests, damaged at random: bytes anywhere; in profiles also values, shapes and",
        "types with sound checksums. Refused: one EdgefilterError of one line. What is taken is used: frames for models,",
        f"in one of 40 cases two seconds through the filter for profiles. {PATIENCE_S} s and {MEMORY >> 30} GiB each at most.",
        "",
        *results_writer.table(["loader", "files", *COLUMNS], rows),
        "",
        f"{len(result['finds'])} finds in {result['inputs']} files, {result['seconds'] / 60:.0f} minutes.",
        "",
    ]
    lines += (
        results_writer.table(
            ["input", "loader", "find"],
            [(find["number"], find["loader"], find["what"]) for find in result["finds"][:50]],
        )
        if result["finds"]
        else []
    )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
