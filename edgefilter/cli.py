"""The command line: parse, call, print, exit code (0 done, 1 failed, 2 wrong usage, 130 interrupted)."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from edgefilter import __version__
from edgefilter.commands.display import STATUS_LEGEND
from edgefilter.commands.outputs import check_outputs
from edgefilter.echo.user_effects import load_effect
from edgefilter.engines import ENGINES, HAVE_MODEL
from edgefilter.errors import EdgefilterError, UsageError

ENGINE = {
    "default": "auto",
    "metavar": "ENGINE",
    "help": f"auto, {', '.join(ENGINES)} (default: %(default)s); docs/cli.md says what each does",
}
EFFECTS = {
    "action": "append",
    "default": [],
    "metavar": "FILE.py",
    "help": "an effect of your own (docs/own_effect.md); repeatable",
}


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
    for add_command in (
        _demo,
        _run,
        _calibrate,
        _compare,
        _diagnose,
        _probe,
        _add,
        _remove,
        _devices,
        _doctor,
        _profile,
    ):
        add_command(commands)
    return parser


def _demo(commands: argparse._SubParsersAction) -> None:
    option = commands.add_parser("demo", help="filter the bundled recording and show before and after").add_argument
    folder = "folder for the WAV files and the picture (default: %(default)s)"
    option("--output", metavar="DIR", default="edgefilter-demo", help=folder)
    told = "instead: two robots that have changed since their calibration, diagnosed and mended (about a minute)"
    option("--hidden", action="store_true", help=told)
    option("--engine", **ENGINE)
    _json(option)


def _run(commands: argparse._SubParsersAction) -> None:
    run = commands.add_parser(
        "run",
        help="filter a recording, a pipe or the microphone",
        description=(
            "Filter a recording, a pipe or the microphone.\n\n  edgefilter run --input mic.wav --reference tts.wav"
            " --profile robot.npz --output human.wav\n  edgefilter run --input mic --profile robot.npz --output"
            " human.wav      (live; Ctrl-C ends it)\n  ... | edgefilter run --input - --output - | ...                 "
            "       (16-bit PCM, 16 kHz: microphone and reference in, mono out)"
        ),
        epilog=STATUS_LEGEND,
    )
    option = run.add_argument
    told = "'mic', a recording, a microphone by its number or a part of its name, or '-': raw PCM on standard input"
    option("--input", required=True, metavar="mic|FILE|DEVICE|-", help=told)
    told = "what the robot says; live, unless given, what the output device plays (its monitor)"
    option("--reference", metavar="FILE|DEVICE", help=told)
    option("--profile", metavar="P.npz", help="calibrated robot, made by 'edgefilter calibrate'")
    option("--engine", **ENGINE)
    option("--model", metavar="FILE.onnx", help=f"network for {' or '.join(HAVE_MODEL)} in place of its own")
    told = "compute per hop (99 of 100 hops within) that auto may use and that a live run keeps to (live default: 8)"
    option("--budget-ms", type=positive, metavar="B", help=told)
    option("--remeasure", action="store_true", help="forget how fast the engines were on this machine")
    told = "WAV or FLAC file, output device, or '-': raw PCM on standard output"
    option("--output", required=True, metavar="FILE|DEVICE|-", help=told)
    _json(option)
    told = "keep microphone, reference, output, events and profile in a new folder"
    option("--record", metavar="FOLDER", help=told)
    option("--log-json", metavar="FILE|-", help="write each event as a line of JSON when it happens")
    told = "write the profile with the echo path as it was adapted in this run"
    option("--save-profile", metavar="P2.npz", help=told)
    told = (
        "run this in a shell whenever the human begins to speak; EDGEFILTER_EVENT and EDGEFILTER_TIME say what and when"
    )
    option("--on-barge-in", type=command, metavar="COMMAND", help=told)
    told = "live: play this speech of the robot, which then is the reference"
    option("--play", metavar="FILE", help=told)
    option("--speaker", metavar="DEVICE", help="output device for --play (default: default)")
    told = "what --play does when the human begins to speak: end, or go on 10 dB lower until the human is quiet"
    option("--barge-in", choices=("stop", "duck"), help=told)
    learning = run.add_mutually_exclusive_group()
    told = "start from what earlier runs have learned if the file exists (else from --profile), and keep there what this one learns"
    learning.add_argument("--learn", metavar="P.npz", help=told)
    told = "do not learn loudspeaker and room while running"
    learning.add_argument("--no-learn", action="store_true", help=told)
    option("--seconds", type=positive, metavar="S", help="stop after S seconds")
    option("--effects", **EFFECTS)
    option("--quiet", action="store_true", help="no progress, no status line")


def _calibrate(commands: argparse._SubParsersAction) -> None:
    calibrate = commands.add_parser(
        "calibrate",
        help="measure the robot's voice and fan at its microphone",
        description=(
            "Measure the robot's voice and fan at its microphone.\n\n  edgefilter calibrate --sweep-reference S.wav"
            " --sweep-recording R.wav --noise-recording FAN.wav --output P.npz\n  edgefilter calibrate --live --output"
            " P.npz                 (plays a sweep and records it)\n  edgefilter calibrate --multisine --excitation"
            " S.wav           (writes the sound that is to be played)"
        ),
    )
    option = calibrate.add_argument
    option("--sweep-reference", metavar="S.wav", help="the sweep as it was sent to the loudspeaker")
    option("--sweep-recording", metavar="R.wav", help="the sweep as the microphone recorded it")
    told = "some seconds of the fan while the robot is silent"
    option("--noise-recording", metavar="FAN.wav", help=told)
    sound = calibrate.add_mutually_exclusive_group()
    told = "multisines at three levels follow the sweep: measure the robot's distortion too"
    sound.add_argument("--multisine", action="store_true", help=told)
    told = "the recordings hold the stepped sine of Li et al. 2024 (0-8001 Hz in steps of 13 Hz)"
    sound.add_argument("--stepped-sine", action="store_true", help=told)
    option("--live", action="store_true", help="play the sweep on --speaker and record it on --input")
    told = "device for --live (default: %(default)s)"
    option("--speaker", default="default", metavar="DEVICE", help=f"output {told}")
    option("--input", default="mic", metavar="DEVICE", help=f"input {told}")
    told = "peak of the played sweep, dB of full scale (default: %(default)s)"
    option("--level-db", type=level, default=-12.0, metavar="DB", help=told)
    option("--save-input", metavar="DIR", help="with --live: also keep the recordings")
    result = calibrate.add_mutually_exclusive_group(required=True)
    result.add_argument("--output", metavar="P.npz", help="profile to write")
    told = "only write the sound that is to be played"
    result.add_argument("--excitation", metavar="S.wav", help=told)
    _json(option)


def _compare(commands: argparse._SubParsersAction) -> None:
    told = "say how far the profile is from a recording of the robot, and where"
    option = commands.add_parser("compare", help=told).add_argument
    _recording(option, profile_needed=False)
    _report(option)


def _diagnose(commands: argparse._SubParsersAction) -> None:
    told = "say which physical effects the profile lacks"
    option = commands.add_parser("diagnose", help=told).add_argument
    told = "write a profile with all that was found; without --profile, one made from the recording"
    option("--apply", metavar="P2.npz", help=told)
    told = "leave out what makes the running filter worse on seconds that no fit has used; takes a little longer"
    option("--prove", action="store_true", help=told)
    told = "share of names that may be given by chance, 0 to 1 (default: 0.01)"
    option("--false-rate", type=rate, default=0.01, metavar="R", help=told)
    told = "write the law that explains most, of a curve, a gain by level or by time, as an effect of your own"
    option("--write-effect", metavar="MINE.py", help=told)
    _force(option)
    _recording(option, profile_needed=False)
    _report(option)


def _probe(commands: argparse._SubParsersAction) -> None:
    told = "where several explanations of a recording remain: the sound that tells them apart, and the odds once it was heard"
    option = commands.add_parser("probe", help=told).add_argument
    option("--live", action="store_true", help="play the sounds here and record them")
    option("--speaker", default="default", metavar="DEVICE", help="output device, with --live (default: %(default)s)")
    option("--input", default="default", metavar="DEVICE", help="microphone, with --live (default: %(default)s)")
    option(
        "--seconds",
        type=positive,
        default=5.0,
        metavar="S",
        help="of sound at most, with --live (default: %(default)g)",
    )
    option("--excitation", metavar="S.wav", help="write the sound there, to be played and recorded elsewhere")
    option("--answer", metavar="R.wav", help="the recording of that sound")
    _recording(option, profile_needed=True)


def _add(commands: argparse._SubParsersAction) -> None:
    told = "fit effects to a recording and write a profile that has them"
    option = commands.add_parser("add", help=told).add_argument
    option("effect", nargs="+", metavar="EFFECT", help="names of effects, as 'diagnose' prints them")
    _force(option)
    _recording(option, profile_needed=True)
    option("--output", required=True, metavar="P2.npz", help="profile to write")


def _remove(commands: argparse._SubParsersAction) -> None:
    option = commands.add_parser("remove", help="write a profile without one of its effects").add_argument
    option("effect", metavar="EFFECT", help="name of the effect, as 'profile show' prints it")
    option("--profile", required=True, metavar="P.npz", help="profile that holds the effect")
    option("--output", required=True, metavar="P2.npz", help="profile to write")
    _json(option)
    option("--effects", **EFFECTS)


def _devices(commands: argparse._SubParsersAction) -> None:
    devices = commands.add_parser("devices", help="list sound devices and the reference that a live run would take")
    option = devices.add_mutually_exclusive_group().add_argument
    _json(option)
    option("--setup", action="store_true", help="print the commands that make a virtual speaker and microphone")
    option("--load", action="store_true", help="make them, until the sound server ends")
    option("--unload", action="store_true", help="remove them")


def _doctor(commands: argparse._SubParsersAction) -> None:
    told = "check whether this machine is fit for a live run, and say what to do"
    option = commands.add_parser("doctor", help=told).add_argument
    option("--input", default="mic", metavar="DEVICE", help="microphone (default: %(default)s)")
    told = "input that records what the loudspeaker plays (default: the one that 'run' takes)"
    option("--reference", metavar="DEVICE", help=told)
    _json(option)


def _profile(commands: argparse._SubParsersAction) -> None:
    profile = commands.add_parser("profile", help="look into a profile")
    show = profile.add_subparsers(dest="word", metavar="show", required=True)
    option = show.add_parser("show", help="print what a profile holds").add_argument
    option("profile", metavar="P.npz")
    option("--plot", metavar="FILE.png", help="draw it")
    _json(option)
    option("--effects", **EFFECTS)


def _recording(option: Callable[..., object], profile_needed: bool) -> None:
    """What is read by commands that work on a recording of the robot alone."""
    without = "" if profile_needed else "; without it a profile is made from the recording"
    told = f"calibrated robot, made by 'edgefilter calibrate'{without}"
    option("--profile", required=profile_needed, metavar="P.npz", help=told)
    told = "the robot alone, as the microphone recorded it, some seconds at least"
    option("--recording", required=True, metavar="MIC", help=told)
    told = "what the robot said, as it was sent to the loudspeaker"
    option("--reference", required=True, metavar="REF", help=told)
    _json(option)
    option("--effects", **EFFECTS)


def _report(option: Callable[..., object]) -> None:
    option("--report", metavar="R.html", help="write a page with pictures and sound, in one file")


def _force(option: Callable[..., object]) -> None:
    option("--force", action="store_true", help="write the profile even if the running filter is worse with it")


def _json(option: Callable[..., object]) -> None:
    option("--json", metavar="FILE", help="write the figures as JSON ('-': standard output)")


def command(text: str) -> str:
    """Words for a shell, not none."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"'{text}' is not a command")
    return text


def rate(text: str) -> float:
    """A share between 0 and 1."""
    return number(text, 0.0, 1.0, "a number between 0 and 1, such as 0.01")


def positive(text: str) -> float:
    """A number above 0."""
    return number(text, 0.0, 1e6, "a number above 0")


def level(text: str) -> float:
    """Level of a peak: at most full scale, and above what 16 bit can hold."""
    return number(text, -90.0, 0.0, "a level from -90 to 0 dB of full scale", closed=True)


def number(text: str, low: float, high: float, expected: str, closed: bool = False) -> float:
    """A number between low and high, closed: or one of them; else an error that says what was expected."""
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
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a pipe gets each line at once; a file name that the terminal's encoding lacks is no reason to stop
        sys.stdout.reconfigure(line_buffering=True, errors="backslashreplace")
    try:
        code = _call(arguments)
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


def _call(arguments: list[str]) -> int:
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
