r"""Robots that talk and are interrupted: on virtual devices in real time, and over minutes and hours of recordings.

    python -m bench live soak --minutes 60                    faster than real time
    python -m bench live hour --minutes 60                    the same on virtual devices
    python -m bench live barge-in --voices ROBOT/test --speech HUMAN/test --count 24 --seed 17 \
        --whisper WHISPER --alone ROBOT/test SYNTHESIZERS --minutes 60 --real RECORDINGS

hour needs PulseAudio, whose private servers make no sound. What each part does stands at the head of its
file in bench/live/. All parts write to the one file of --output.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.live import barge_in, soak
from bench.simulate.microphones import MICROPHONES
from edgefilter.errors import UsageError

PARTS = {"barge-in": barge_in.run, "soak": soak.run, "hour": soak.run}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("part", choices=tuple(PARTS))
    add("--voices", type=Path, nargs="+", metavar="DIR", help="folders of the robot's sentences")
    add("--speech", type=Path, metavar="DIR", help="folder of human speech")
    add("--minutes", type=float, default=10.0, help="of the run, or of robot speech (default: %(default)s)")
    add("--count", type=int, default=16, help="conversations (default: %(default)s)")
    add("--engine", help="default: auto; of barge-in crnn")
    uninterrupted = "barge-in: voices of robots that nobody interrupts"
    add("--alone", type=Path, nargs="*", default=[], metavar="DIR", help=uninterrupted)
    add(
        "--ask-db",
        type=float,
        default=0.0,
        metavar="DB",
        help="barge-in: by how much a robot lowers its voice that is asked to",
    )
    add(
        "--microphone",
        choices=tuple(MICROPHONES),
        help="barge-in: processing of the microphone, or a sound that it hears besides voices (bench/simulate/microphones.py)",
    )
    add("--sound", type=Path, metavar="DIR", help="barge-in: folder for WAV files of what robots play and hear")
    add("--real", type=Path, metavar="DIR", help="barge-in: recordings of a real loudspeaker alone")


def run(options: argparse.Namespace) -> str:
    for name in ("voices", "speech") if options.part == "barge-in" else ():
        if getattr(options, name) is None:
            raise UsageError(f"the part '{options.part}' needs --{name}, a folder with a transcripts.tsv")
    return PARTS[options.part](options)
