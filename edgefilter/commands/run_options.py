"""The options of `edgefilter run`."""

from __future__ import annotations

import argparse

from edgefilter.commands.arguments import command, effects_option, positive
from edgefilter.engines import ENGINES, HAVE_MODEL


def add_run(commands: argparse._SubParsersAction) -> None:
    """The command and all its options."""
    run = commands.add_parser(
        "run",
        help="filter a recording, a pipe or the microphone",
        description=(
            "Filter a recording, a pipe or the microphone.\n\n  edgefilter run --input mic.wav --reference tts.wav"
            " --profile robot.npz --output human.wav\n  edgefilter run --input mic --profile robot.npz --output"
            " human.wav      (live; Ctrl-C ends it)\n  ... | edgefilter run --input - --output - | ...                 "
            "       (s16le 16 kHz: stereo in, mono out)"
        ),
    )
    run.add_argument(
        "--input",
        required=True,
        metavar="mic|FILE|DEVICE|-",
        help="microphone device (number or part of its name), recording, or raw PCM",
    )
    run.add_argument(
        "--reference",
        metavar="FILE|DEVICE",
        help="what the robot says; live it defaults to the monitor of the default output",
    )
    run.add_argument("--profile", metavar="P.npz", help="calibrated robot, made by 'edgefilter calibrate'")
    run.add_argument(
        "--engine", default="auto", metavar="ENGINE", help=f"auto, {', '.join(ENGINES)} (default: %(default)s)"
    )
    run.add_argument("--model", metavar="FILE.onnx", help=f"network for {' or '.join(HAVE_MODEL)} in place of its own")
    run.add_argument(
        "--budget-ms",
        type=positive,
        metavar="B",
        help="compute per hop (p99) that auto may use, and that a live run keeps to (live default: 8)",
    )
    run.add_argument("--remeasure", action="store_true", help="forget how fast the engines were on this machine")
    run.add_argument(
        "--output", required=True, metavar="FILE|DEVICE|-", help="WAV or FLAC file, output device, or raw PCM"
    )
    run.add_argument("--json", metavar="FILE", help="write what happened as JSON")
    run.add_argument(
        "--record", metavar="FOLDER", help="keep microphone, reference, output, events and profile in a new folder"
    )
    run.add_argument("--log-json", metavar="FILE|-", help="write each event as a line of JSON when it happens")
    run.add_argument(
        "--save-profile", metavar="P2.npz", help="write the profile with the echo path as it was adapted in this run"
    )
    _add_acting(run)
    learning = run.add_mutually_exclusive_group()
    learning.add_argument(
        "--learn",
        metavar="P.npz",
        help="begin with what was learned in earlier runs, where the file exists (else with --profile), go on learning,"
        " and keep it there",
    )
    learning.add_argument("--no-learn", action="store_true", help="do not learn loudspeaker and room while running")
    run.add_argument("--seconds", type=positive, metavar="S", help="stop after S seconds")
    effects_option(run)
    run.add_argument("--quiet", action="store_true", help="no progress bar, no status line")


def _add_acting(run: argparse.ArgumentParser) -> None:
    run.add_argument(
        "--on-barge-in",
        type=command,
        metavar="COMMAND",
        help="run this in a shell whenever the human begins to speak (EDGEFILTER_EVENT, EDGEFILTER_TIME say what, when)",
    )
    run.add_argument("--play", metavar="FILE", help="live: play this speech of the robot, which then is the reference")
    run.add_argument("--speaker", metavar="DEVICE", help="output device for --play (default: default)")
    run.add_argument(
        "--barge-in",
        choices=("stop", "duck"),
        help="what --play does when the human begins to speak: end, or go on 10 dB lower until it is quiet again",
    )
