"""The command line: parse, call, print, exit code (0 done, 1 failed, 2 wrong usage, 130 interrupted)."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from typing import Any, NoReturn

from edgefilter import __version__
from edgefilter.commands.outputs import check_outputs
from edgefilter.echo.user_effects import load_effect
from edgefilter.engines import ENGINES, HAVE_MODEL
from edgefilter.errors import EdgefilterError, UsageError


class Parser(argparse.ArgumentParser):
    """argparse with one line per mistake and no abbreviated flags."""

    def __init__(self, **options: Any) -> None:
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise what main() turns into one line."""
        raise UsageError(f"{message}; see '{self.prog} --help'")


def build_parser() -> Parser:
    """All commands and their options."""
    parser = Parser(prog="edgefilter", description="Hear the human while the robot talks.")
    parser.add_argument("--version", action="version", version=f"edgefilter {__version__}")
    parser.add_argument("--debug", action="store_true", help="show a traceback when something fails")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    _add_demo(commands)
    _add_run(commands)
    _add_calibrate(commands)
    _add_diagnosis(commands)
    _add_devices(commands)
    _add_profile(commands)
    return parser


def _add_demo(commands: argparse._SubParsersAction) -> None:
    demo = commands.add_parser("demo", help="filter the bundled recording and show before and after")
    demo.add_argument(
        "--output",
        metavar="DIR",
        default="edgefilter-demo",
        help="folder for the WAV files and the picture (default: %(default)s)",
    )
    demo.add_argument(
        "--engine", default="auto", metavar="ENGINE", help=f"auto, {', '.join(ENGINES)} (default: %(default)s)"
    )
    demo.add_argument("--json", metavar="FILE", help="write the figures as JSON ('-': standard output)")


def _add_run(commands: argparse._SubParsersAction) -> None:
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
        type=_positive,
        metavar="B",
        help="compute per hop (p99) that auto may use, and that a live run keeps to (live default: 8)",
    )
    run.add_argument("--remeasure", action="store_true", help="forget how fast the engines were on this machine")
    run.add_argument(
        "--output", required=True, metavar="FILE|DEVICE|-", help="WAV or FLAC file, output device, or raw PCM"
    )
    run.add_argument("--json", metavar="FILE", help="write what happened as JSON")
    run.add_argument("--save-input", metavar="DIR", help="also write what was heard: DIR/mic.wav and DIR/reference.wav")
    run.add_argument(
        "--save-profile", metavar="P2.npz", help="write the profile with the echo path as it was adapted in this run"
    )
    learning = run.add_mutually_exclusive_group()
    learning.add_argument(
        "--learn",
        metavar="P.npz",
        help="begin with what was learned in earlier runs, where the file exists (else with --profile), go on learning,"
        " and keep it there",
    )
    learning.add_argument("--no-learn", action="store_true", help="do not learn loudspeaker and room while running")
    run.add_argument("--seconds", type=_positive, metavar="S", help="stop after S seconds")
    _effects_option(run)
    run.add_argument("--quiet", action="store_true", help="no progress bar, no level meter")


def _add_calibrate(commands: argparse._SubParsersAction) -> None:
    calibrate = commands.add_parser(
        "calibrate",
        help="measure the robot's voice and fan at its microphone",
        description=(
            "Measure the robot's voice and fan at its microphone.\n\n  edgefilter calibrate --sweep-reference S.wav"
            " --sweep-recording R.wav --noise-recording FAN.wav --output P.npz\n  edgefilter calibrate --live --output"
            " P.npz                             (plays a sweep and records it)"
        ),
    )
    calibrate.add_argument("--sweep-reference", metavar="S.wav", help="the sweep as it was sent to the loudspeaker")
    calibrate.add_argument("--sweep-recording", metavar="R.wav", help="the sweep as the microphone heard it")
    calibrate.add_argument(
        "--noise-recording", metavar="FAN.wav", help="the robot silent, its fan running, a few seconds"
    )
    calibrate.add_argument(
        "--stepped-sine",
        action="store_true",
        help="the recordings hold the paper's stepped sine (0-8001 Hz, 13 Hz steps)",
    )
    calibrate.add_argument("--live", action="store_true", help="play the sweep on --speaker and record it on --input")
    calibrate.add_argument(
        "--speaker", default="default", metavar="DEVICE", help="output device for --live (default: %(default)s)"
    )
    calibrate.add_argument(
        "--input", default="mic", metavar="DEVICE", help="input device for --live (default: %(default)s)"
    )
    peak = "peak of the played sweep, dB of full scale (default: %(default)s)"
    calibrate.add_argument("--level-db", type=_level, default=-12.0, metavar="DB", help=peak)
    calibrate.add_argument("--save-input", metavar="DIR", help="with --live: also keep the recordings")
    calibrate.add_argument("--output", required=True, metavar="P.npz", help="profile to write")
    calibrate.add_argument("--json", metavar="FILE", help="write the result as JSON ('-': standard output)")


def _add_diagnosis(commands: argparse._SubParsersAction) -> None:
    compare = commands.add_parser("compare", help="say how far the profile is from a recording of the robot, and where")
    diagnose = commands.add_parser("diagnose", help="say which physical effects the profile lacks")
    add = commands.add_parser("add", help="fit effects to a recording and write a profile that has them")
    remove = commands.add_parser("remove", help="write a profile without one of its effects")
    add.add_argument("effect", nargs="+", metavar="EFFECT", help="names of effects, as 'diagnose' prints them")
    remove.add_argument("effect", metavar="EFFECT", help="name of the effect, as 'profile show' prints it")
    diagnose.add_argument(
        "--apply",
        metavar="P2.npz",
        help="write a profile with all that was found; without --profile, one made from the recording",
    )
    for command in (add, diagnose):
        command.add_argument(
            "--force", action="store_true", help="write it even where the running filter is worse with it"
        )
    for command in (compare, diagnose, add, remove):
        needed = command in (add, remove)
        told = "calibrated robot, made by 'edgefilter calibrate'" + (
            "" if needed else "; without it the recording itself speaks for the robot"
        )
        command.add_argument("--profile", required=needed, metavar="P.npz", help=told)
        if command is not remove:
            command.add_argument(
                "--recording",
                required=True,
                metavar="MIC",
                help="the robot alone, as the microphone heard it, from some seconds up",
            )
            command.add_argument(
                "--reference",
                required=True,
                metavar="REF",
                help="what the robot said, as it was sent to the loudspeaker",
            )
        if command in (add, remove):
            command.add_argument("--output", required=True, metavar="P2.npz", help="profile to write")
        else:
            command.add_argument("--report", metavar="R.html", help="write a page with pictures and sound, in one file")
        command.add_argument("--json", metavar="FILE", help="write the result as JSON ('-': standard output)")
        _effects_option(command)


def _effects_option(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--effects",
        action="append",
        default=[],
        metavar="FILE.py",
        help="an effect of your own (see docs/own_effect.md); repeatable",
    )


def _add_devices(commands: argparse._SubParsersAction) -> None:
    devices = commands.add_parser("devices", help="list sound devices and the reference that live use would take")
    devices.add_argument("--json", metavar="FILE", help="write the list as JSON ('-': standard output)")


def _add_profile(commands: argparse._SubParsersAction) -> None:
    profile = commands.add_parser("profile", help="look into a profile")
    words = profile.add_subparsers(dest="word", metavar="show", required=True)
    show = words.add_parser("show", help="print what a profile holds")
    show.add_argument("profile", metavar="P.npz")
    show.add_argument("--plot", metavar="FILE.png", help="draw it")
    show.add_argument("--json", metavar="FILE", help="write it as JSON ('-': standard output)")
    _effects_option(show)


def _positive(text: str) -> float:
    return _number(text, 0.0, 1e6, "a number above 0")


def _level(text: str) -> float:
    """Of a peak: at most full scale, and above what 16 bit can hold."""
    return _number(text, -90.0, 0.0, "a level from -90 to 0 dB of full scale", closed=True)


def _number(text: str, low: float, high: float, expected: str, closed: bool = False) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not (low <= value <= high if closed else low < value < high):
        raise argparse.ArgumentTypeError(f"'{text}' is not {expected}")
    return value


def main(argv: list[str] | None = None) -> int:
    """Run one command; every expected failure is one line on standard error."""
    arguments = sys.argv[1:] if argv is None else argv
    debug = "--debug" in arguments
    if hasattr(sys.stdout, "reconfigure"):  # a file name that the terminal's encoding lacks is no reason to stop
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = _run(arguments)
        sys.stdout.flush()  # what is still buffered fails here, with a reason, or at exit, with a traceback
        return code
    except UsageError as error:
        return _fail(error, 2, debug)
    except EdgefilterError as error:
        return _fail(error, 1, debug)
    except BrokenPipeError:
        _forget_output()
        return 1
    except KeyboardInterrupt:
        print("edgefilter: interrupted", file=sys.stderr)
        return 130
    except OSError as error:
        _forget_output()
        return _fail(f"{error.filename or 'system'}: {error.strerror or error}", 1, debug)


def _run(arguments: list[str]) -> int:
    parser = build_parser()
    args = parser.parse_args(arguments)
    if args.command is None:
        parser.print_help()
        return 0
    check_outputs(args)
    for file in getattr(args, "effects", []):
        load_effect(file)
    return importlib.import_module(f"edgefilter.commands.{args.command}").main(args)


def _forget_output() -> None:
    """Where standard output takes nothing any more, let what is left go nowhere: Python tries once more at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _fail(error: object, code: int, debug: bool) -> int:
    if debug:
        raise error if isinstance(error, BaseException) else RuntimeError(error)
    print(f"edgefilter: {' '.join(str(error).split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
