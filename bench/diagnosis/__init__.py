r"""How often hidden effects are named, and whether what is named makes the running filter better on unseen seconds.

    python -m bench diagnosis names --cases DIR ... --output bench/results/diagnosis
    python -m bench diagnosis proof --cases DIR ... --real DIR ... --output bench/results/diagnosis
    python -m bench diagnosis run-time --voices ROBOT/test --speech HUMAN/test --count 8 --seed 41 \
        --output bench/results/diagnosis
    python -m bench diagnosis probe --voices ROBOT/test --count 4 --seed 35 --output bench/results/diagnosis
    python -m bench diagnosis ordinary --cases DIR ... (--learn edgefilter/diagnosis/ordinary.json | --output ...)

names, proof, ordinary: --cases are folders of cases as bench.simulate.hidden_cases and bench.simulate.wild write them; proof needs
no labels, so that real recordings do as well. run-time and probe simulate their own. What each part does stands at the head of its
file in bench/diagnosis/. All parts write to the one file of --output.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.diagnosis import names, ordinary, probe, proof, run_time
from bench.simulate.hidden_cases import EFFECTS
from edgefilter.errors import UsageError

PARTS = {"names": names.run, "proof": proof.run, "run-time": run_time.run, "probe": probe.run, "ordinary": ordinary.run}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("part", choices=tuple(PARTS))
    add("--cases", type=Path, nargs="+", default=[], metavar="DIR", help="names, proof, ordinary: folders of cases")
    add("--learn", type=Path, metavar="FILE", help="ordinary: write the table of what happens by chance there")
    add("--real", type=Path, nargs="+", default=[], metavar="DIR", help="proof: pairs NAME_lpb and NAME_mic")
    add("--voices", type=Path, metavar="DIR", help="run-time, probe: the robot's voices")
    add("--speech", type=Path, metavar="DIR", help="run-time: the humans")
    counts = "run-time: conversations of each effect; probe: robots of each pair and truth (default: %(default)s)"
    add("--count", type=int, default=8, help=counts)
    add("--effects", default=",".join(EFFECTS), metavar="A,B,...", help="run-time: which of them (default: all)")
    add("--engines", default=",".join(run_time.ENGINES), metavar="A,B,...", help="run-time (default: %(default)s)")


def run(options: argparse.Namespace) -> str:
    if options.part == "run-time" and not (options.voices and options.speech):
        raise UsageError("the part 'run-time' needs --voices and --speech, folders with a transcripts.tsv")
    if options.part == "probe" and not options.voices:
        raise UsageError("the part 'probe' needs --voices, a folder with a transcripts.tsv")
    given = options.cases or (options.part == "proof" and options.real)
    if options.part in ("names", "proof", "ordinary") and not given:
        raise UsageError(f"the part '{options.part}' needs --cases, folders of bench.simulate.hidden_cases")
    return PARTS[options.part](options)
