"""The command line: parse, call, print, exit code (0 done, 1 failed, 2 wrong usage, 130 interrupted)."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from typing import Any, NoReturn

from edgefilter import __version__
from edgefilter.commands.arguments import effects_option, level
from edgefilter.commands.outputs import check_outputs
from edgefilter.commands.run_options import add_run
from edgefilter.echo.user_effects import load_effect
from edgefilter.engines import ENGINES
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
    add_run(commands)
    _add_calibrate(commands)
    _add_diagnosis(commands)
    _add_devices(commands)
    _add_doctor(commands)
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
        "--hidden", action="store_true", help="instead: robots to which something happened, diagnosed and mended"
    )
    demo.add_argument(
        "--engine", default="auto", metavar="ENGINE", help=f"auto, {', '.join(ENGINES)} (default: %(default)s)"
    )
    demo.add_argument("--json", metavar="FILE", help="write the figures as JSON ('-': standard output)")


def _add_calibrate(commands: argparse._SubParsersAction) -> None:
    calibrate = commands.add_parser(
        "calibrate",
        help="measure the robot's voice and fan at its microphone",
        description=(
            "Measure the robot's voice and fan at its microphone.\n\n  edgefilter calibrate --sweep-reference S.wav"
            " --sweep-recording R.wav --noise-recording FAN.wav --output P.npz\n  edgefilter calibrate --live --output"
            " P.npz                             (plays a sweep and records it)\n  edgefilter calibrate --multisine --excitation"
            " S.wav                       (writes what is to be played)"
        ),
    )
    calibrate.add_argument("--sweep-reference", metavar="S.wav", help="the sweep as it was sent to the loudspeaker")
    calibrate.add_argument("--sweep-recording", metavar="R.wav", help="the sweep as the microphone heard it")
    calibrate.add_argument(
        "--noise-recording", metavar="FAN.wav", help="the robot silent, its fan running, a few seconds"
    )
    sound = calibrate.add_mutually_exclusive_group()
    sound.add_argument(
        "--multisine",
        action="store_true",
        help="behind the sweep come multisines at three levels: measure the robot's distortion too",
    )
    sound.add_argument(
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
    calibrate.add_argument("--level-db", type=level, default=-12.0, metavar="DB", help=peak)
    calibrate.add_argument("--save-input", metavar="DIR", help="with --live: also keep the recordings")
    result = calibrate.add_mutually_exclusive_group(required=True)
    result.add_argument("--output", metavar="P.npz", help="profile to write")
    result.add_argument("--excitation", metavar="S.wav", help="write the sound to be played, and nothing else")
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
    diagnose.add_argument(
        "--prove",
        action="store_true",
        help="do not name what makes the running filter worse on seconds that no fit has seen; takes a little longer",
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
        effects_option(command)


def _add_devices(commands: argparse._SubParsersAction) -> None:
    devices = commands.add_parser("devices", help="list sound devices and the reference that live use would take")
    word = devices.add_mutually_exclusive_group()
    word.add_argument("--json", metavar="FILE", help="write the list as JSON ('-': standard output)")
    word.add_argument("--setup", action="store_true", help="print what makes a virtual speaker and microphone")
    word.add_argument("--load", action="store_true", help="make them, until the sound server ends")
    word.add_argument("--unload", action="store_true", help="remove them")


def _add_doctor(commands: argparse._SubParsersAction) -> None:
    doctor = commands.add_parser("doctor", help="check whether this machine is fit for a live run, and say what to do")
    doctor.add_argument("--input", default="mic", metavar="DEVICE", help="microphone (default: %(default)s)")
    doctor.add_argument("--reference", metavar="DEVICE", help="input that hears the loudspeaker (default: as of run)")
    doctor.add_argument("--json", metavar="FILE", help="write the findings as JSON ('-': standard output)")


def _add_profile(commands: argparse._SubParsersAction) -> None:
    profile = commands.add_parser("profile", help="look into a profile")
    words = profile.add_subparsers(dest="word", metavar="show", required=True)
    show = words.add_parser("show", help="print what a profile holds")
    show.add_argument("profile", metavar="P.npz")
    show.add_argument("--plot", metavar="FILE.png", help="draw it")
    show.add_argument("--json", metavar="FILE", help="write it as JSON ('-': standard output)")
    effects_option(show)


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
