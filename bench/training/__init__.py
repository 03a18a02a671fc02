r"""What chooses a network, on validation speakers and voices, never on test ones.

    python -m bench training words --networks RUN/last.onnx [...] --conversations VALIDATION/paper VALIDATION/live \
        --cold --real RECORDINGS --speech HUMAN/val --whisper WHISPER --output PATH
    python -m bench training probability --real RECORDINGS --speech HUMAN/val \
        --conversations VALIDATION/paper VALIDATION/live --every 3 --output PATH

words: which network of export.onnx_export keeps the words. probability: the scale and bias by which the speech head's probability is one.
What each does stands at the head of its file in bench/training/. RECORDINGS: of a device of many recordings the half
that is to tune on.
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

from bench.recordings import Recording, find_recordings
from edgefilter.errors import UsageError

PARTS = ("words", "probability")
"""Modules of this folder, each imported where it runs."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("part", choices=PARTS)
    add("--conversations", type=Path, nargs="*", default=[], metavar="DIR", help="of bench.simulate.conversations")
    add("--real", type=Path, metavar="DIR", help="recordings of real devices, the robot alone")
    add("--speech", type=Path, metavar="DIR", help="humans that are laid on them")
    add("--cases", type=int, default=8, metavar="N", help="humans that are laid on them at each level")
    add("--networks", type=Path, nargs="*", default=[], metavar="FILE.onnx", help="words: trained networks")
    add("--cold", action="store_true", help="words: each conversation once more without its profile")
    add("--silent", action="store_true", help="words: each conversation once more in which the robot says nothing")
    add("--learning", action="store_true", help="words: the filter learns while it runs")
    add("--wiener", type=float, nargs="*", default=[0.5], metavar="SHARE", help="words: shares of 'ss' in the answer")
    add("--error", type=float, nargs="*", default=[0.2], metavar="SHARE", help="words: shares of the linear error")
    add("--false-starts", type=float, default=15.0, metavar="N", help="probability: an hour that may be (default: 15)")


def run(options: argparse.Namespace) -> str:
    if not options.conversations and not options.real:
        raise UsageError("nothing to listen to: give --conversations, or --real with --speech")
    if options.real and not options.speech:
        raise UsageError("--real lays humans on recordings: give --speech with a transcripts.tsv")
    options.alone = tuning_half(options.real) if options.real else []
    return importlib.import_module(f"bench.training.{options.part}").run(options)


def tuning_half(folder: Path) -> list[Recording]:
    """The robot alone, on devices of many recordings, as far as they are to tune on."""
    found = [one for one in find_recordings(folder) if one.tuned_on and one.kind == "farend"]
    if not found:
        raise UsageError(f"{folder} holds no device of many recordings (NAME_00_lpb, NAME_01_lpb, ...)")
    return found
