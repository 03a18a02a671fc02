"""The command line: parse, call, print, exit code (0 done, 1 failed, 2 wrong usage, 130 interrupted)."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, get_args

from edgefilter import __version__
from edgefilter.commands.display import STATUS_LEGEND, own_words_only
from edgefilter.commands.outputs import check_outputs
from edgefilter.commands.signals import on_signal
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.echo.effects.catalogue import names
from edgefilter.echo.user_effects import load_effect
from edgefilter.engines import HAVE_MODEL
from edgefilter.errors import EdgefilterError, UsageError, printable
from edgefilter.options import ASK, CONFIRM, ENGINE, FALSE_STARTS, MIC_CHANNELS, channel, number, positive, whole
from edgefilter.types import SoundFor

EFFECTS = {
    "action": "append",
    "default": [],
    "metavar": "FILE.py",
    "help": "an effect of your own (docs/own_effect.md); repeatable",
}
JSON = {"metavar": "FILE", "help": "write the figures as JSON ('-': standard output)"}
REPORT = {"metavar": "R.html", "help": "write a page with pictures and sound, in one file"}
VERBOSE = {"action": "store_true", "help": "print every figure in place of ten lines"}
FORCE = {"action": "store_true", "help": "write the profile even if the running filter is worse with it"}


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
    parser.add_argument(
        "--debug", action="store_true", help="show a traceback when something fails, and what C libraries print"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for add_command in (_demo, _run, _calibrate, _compare, _diagnose, _probe, _passport, _add, _remove):
        add_command(commands)
    for add_command in (_devices, _doctor, _serve, _ros2, _profile):
        add_command(commands)
    return parser


def _demo(commands: argparse._SubParsersAction) -> None:
    option = commands.add_parser("demo", help="filter the bundled recording and show before and after").add_argument
    folder = "folder for the WAV files and the picture (default: %(default)s)"
    option("--output", metavar="DIR", default="edgefilter-demo", help=folder)
    told = "instead: diagnose and correct two robots that have changed since their calibration (about a minute)"
    option("--hidden", action="store_true", help=told)
    option("--engine", **ENGINE)
    option("--json", **JSON)


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
    told = "what the robot says; a live run without it takes what the output device plays (its monitor)"
    option("--reference", metavar="FILE|DEVICE", help=told)
    option("--mic-channels", **MIC_CHANNELS)
    told = "channel of --input, counted from 0, that holds what the robot says; needs --mic-channels"
    option("--reference-channel", type=channel, metavar="N", help=told)
    option("--profile", metavar="P.npz", help="calibrated robot, made by 'edgefilter calibrate'")
    option("--engine", **ENGINE)
    told = "for a recogniser, or to listen to, lower where nobody speaks (default: %(default)s)"
    option("--sound", choices=get_args(SoundFor), default="recognise", help=told)
    option("--model", metavar="FILE.onnx", help=f"network for {' or '.join(HAVE_MODEL)} in place of its own")
    told = (
        "computing time for a hop, kept in 99 of 100 hops: auto and a live run choose engines by it (live default: 8)"
    )
    option("--budget-ms", type=positive, metavar="B", help=told)
    told = "forget how fast the engines were on this machine; a live run, or --budget-ms, measures them again for auto"
    option("--remeasure", action="store_true", help=told)
    told = "WAV or FLAC file, output device, or '-': raw PCM on standard output"
    option("--output", required=True, metavar="FILE|DEVICE|-", help=told)
    option("--json", **JSON)
    option("--record", metavar="FOLDER", help="keep microphone, reference, output, events and profile in a new folder")
    option("--turns", metavar="FOLDER", help="write each finished turn of the human to a WAV file there")
    option("--log-json", metavar="FILE|-", help="write each event as a line of JSON when it happens")
    option("--save-profile", metavar="P2.npz", help="write the profile with the echo path that this run has adapted")
    told = (
        "run this in a shell whenever the human begins to speak; EDGEFILTER_EVENT and EDGEFILTER_TIME say what and when"
    )
    option("--on-barge-in", type=command, metavar="COMMAND", help=told)
    told = "the same when the human may have begun (speech_suspected) and when nobody has (speech_dismissed)"
    option("--on-suspicion", type=command, metavar="COMMAND", help=told)
    option("--confirm-s", **CONFIRM)
    option("--false-starts-per-hour", **FALSE_STARTS)
    option("--play", metavar="FILE", help="live: play this speech of the robot, which then is the reference")
    option("--speaker", metavar="DEVICE", help="output device for --play (default: default)")
    told = "when the human begins to speak, end what --play plays, or lower it by 10 dB until the human is quiet"
    option("--barge-in", choices=("stop", "duck"), help=told)
    option("--ask-db", **ASK)
    learning = run.add_mutually_exclusive_group()
    told = "start from what earlier runs have learned if the file exists (else from --profile), and keep there what this one learns"
    learning.add_argument("--learn", metavar="P.npz", help=told)
    learning.add_argument("--no-learn", action="store_true", help="do not learn loudspeaker and room while running")
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
    option("--noise-recording", metavar="FAN.wav", help="some seconds of the fan while the robot is silent")
    option("--mic-channels", **MIC_CHANNELS)
    told = "multisines at three levels follow the sweep: measure the robot's distortion too"
    option("--multisine", action="store_true", help=told)
    told = "MIC: the robot, which talks and moves while nobody else speaks; REF: what it says (with --live: neither)"
    option("--while-moving", nargs="*", metavar="MIC REF", help=told)
    _live(option, "play the sweep on --speaker and record it on --input")
    level = number(-90.0, 0.0, "a level from -90 to 0 dB of full scale", closed=True)
    told = "peak of the played sweep, dB of full scale (default: %(default)s)"
    option("--level-db", type=level, default=-12.0, metavar="DB", help=told)
    option("--save-input", metavar="DIR", help="with --live: also keep the recordings")
    result = calibrate.add_mutually_exclusive_group(required=True)
    result.add_argument("--output", metavar="P.npz", help="profile to write")
    result.add_argument("--excitation", metavar="S.wav", help="only write the sound that is to be played")
    option("--json", **JSON)


def _compare(commands: argparse._SubParsersAction) -> None:
    told = "say how much of a recording of the robot the profile does not explain, and where"
    option = commands.add_parser("compare", help=told).add_argument
    _recording(option, profile_needed=False)
    option("--verbose", **VERBOSE)
    option("--report", **REPORT)


def _diagnose(commands: argparse._SubParsersAction) -> None:
    told = "say which physical effects the profile lacks"
    option = commands.add_parser("diagnose", help=told).add_argument
    told = "write a profile with all that was found; without --profile, one made from the recording"
    option("--apply", metavar="P2.npz", help=told)
    option("--verbose", **VERBOSE)
    told = "where no effect explains the recording: write the curve, gain, filter or lag that does as an effect of your own"
    option("--write-effect", type=effect_file, metavar="MINE.py", help=told)
    option("--mic-channels", **MIC_CHANNELS)
    told = "the one of --mic-channels that is diagnosed (default: the first); all of them are looked at"
    option("--channel", type=channel, metavar="N", help=told)
    told = "leave out what makes the running filter worse on seconds that no fit has used; takes a little longer"
    option("--prove", action="store_true", help=told)
    rate = number(1e-6, 0.5, "a share from 0.000001 to 0.5, such as 0.01 for 1 in 100", closed=True)
    told = "share of ordinary recordings in which an effect may be named by chance (default: %(default)g)"
    option("--false-rate", type=rate, default=Criteria.false_rate, metavar="P", help=told)
    option("--force", **FORCE)
    _recording(option, profile_needed=False)
    option("--report", **REPORT)


def _probe(commands: argparse._SubParsersAction) -> None:
    probe = commands.add_parser(
        "probe",
        help="play what tells apart the explanations that a diagnosis leaves, and say which it is",
        description=(
            "Play what tells apart the explanations that a diagnosis leaves, and say which it is.\n\n"
            "  edgefilter probe --profile robot.npz --recording mic.wav --reference tts.wav --live\n\n"
            "or on a robot that this program does not run on:\n\n"
            "  edgefilter probe --profile robot.npz --recording mic.wav --reference tts.wav --excitation probe.wav\n"
            "  edgefilter probe --profile robot.npz --recording answer.wav --excitation probe.wav"
        ),
    )
    option = probe.add_argument
    told = "effects, joined by + where several are one explanation (default: what the diagnosis leaves)"
    option("explanation", nargs="*", metavar="EXPLANATION", help=told)
    option("--profile", required=True, metavar="P.npz", help="calibrated robot, made by 'edgefilter calibrate'")
    told = "the robot alone, of which several explanations remain; without --reference: what was heard of --excitation"
    option("--recording", required=True, metavar="MIC", help=told)
    option("--reference", metavar="REF", help="what the robot said there, as it was sent to the loudspeaker")
    _live(option, "play on --speaker and record on --input")
    option("--seconds", type=positive, default=5.0, metavar="S", help="of sound at most (default: %(default)g)")
    told = (
        "the sound to be played, written there, with what is asked in S.wav.json; without --reference: that was played"
    )
    option("--excitation", metavar="S.wav", help=told)
    option("--json", **JSON)
    option("--effects", **EFFECTS)


def _passport(commands: argparse._SubParsersAction) -> None:
    told = "describe an unknown device from one recording, and predict how well the filter works there"
    option = commands.add_parser("passport", help=told).add_argument
    told = "the robot alone, as the microphone recorded it, 10 s or more; the first 60 s are taken"
    option("--recording", required=True, metavar="MIC", help=told)
    option("--reference", required=True, metavar="REF", help="what the robot said, as it was sent to the loudspeaker")
    told = "which engine is tried; repeatable (default: all of them)"
    option("--engine", action="append", choices=("linear", "ss", "crnn"), help=told)
    level = number(-40.0, 20.0, "a level from -40 to 20 dB", closed=True)
    told = "level of the human, dB relative to the robot, for which the SI-SDR is predicted (default: %(default)s)"
    option("--human-db", type=level, default=-10.0, metavar="DB", help=told)
    option("--no-diagnosis", action="store_true", help="do not look for physical effects, which takes longest")
    option("--json", **JSON)
    option("--report", **REPORT)


def _add(commands: argparse._SubParsersAction) -> None:
    told = "fit effects to a recording and write a profile that has them"
    option = commands.add_parser("add", help=told).add_argument
    option("effect", nargs="+", metavar="EFFECT", help="names of effects, as 'diagnose' prints them")
    option("--force", **FORCE)
    _recording(option, profile_needed=True)
    option("--output", required=True, metavar="P2.npz", help="profile to write")


def _remove(commands: argparse._SubParsersAction) -> None:
    option = commands.add_parser("remove", help="write a profile without one of its effects").add_argument
    option("effect", metavar="EFFECT", help="name of the effect, as 'profile show' prints it")
    option("--profile", required=True, metavar="P.npz", help="profile that holds the effect")
    option("--output", required=True, metavar="P2.npz", help="profile to write")
    option("--json", **JSON)
    option("--effects", **EFFECTS)


def _devices(commands: argparse._SubParsersAction) -> None:
    devices = commands.add_parser("devices", help="list sound devices and the reference that a live run would take")
    option = devices.add_mutually_exclusive_group().add_argument
    option("--json", **JSON)
    option("--setup", action="store_true", help="print the commands that make a virtual speaker and microphone")
    option("--load", action="store_true", help="make them, until the sound server ends")
    option("--unload", action="store_true", help="remove them")


def _doctor(commands: argparse._SubParsersAction) -> None:
    told = "check whether a live run works on this machine, and say what to change"
    option = commands.add_parser("doctor", help=told).add_argument
    option("--input", default="mic", metavar="DEVICE", help="microphone (default: %(default)s)")
    option("--mic-channels", **MIC_CHANNELS)
    option("--profile", metavar="P.npz", help="calibrated robot, with whose microphones these are compared")
    told = "input that records what the loudspeaker plays (default: the one that 'run' takes)"
    option("--reference", metavar="DEVICE", help=told)
    told = "output that plays chirps, 5 s with a peak of -18 dB of full scale: where the robot plays (default: %(default)s)"
    option("--speaker", default="default", metavar="DEVICE", help=told)
    option("--no-chirp", action="store_true", help="play nothing")
    option("--json", **JSON)


def _serve(commands: argparse._SubParsersAction) -> None:
    told = "filter for devices whose microphone is elsewhere, over WebSocket (docs/serve.md)"
    option = commands.add_parser("serve", help=told).add_argument
    told = "address to serve (default: %(default)s, which only this machine reaches); any other needs --token"
    option("--host", default="127.0.0.1", metavar="ADDRESS", help=told)
    told = "0: any that is free (default: %(default)s)"
    option("--port", type=whole(0, 65535, "a port, 0 to 65535"), default=10620, metavar="N", help=told)
    option("--token", metavar="FILE", help="file with the secret that a client has to send")
    option("--profile", metavar="P.npz", help="calibrated robot, of all clients")
    option("--engine", **ENGINE)
    option("--confirm-s", **CONFIRM)
    option("--false-starts-per-hour", **FALSE_STARTS)
    streams = whole(1, 10_000, "a number of streams, 1 or more")
    option("--streams", type=streams, metavar="N", help="clients at a time (default: 4 a core)")


def _ros2(commands: argparse._SubParsersAction) -> None:
    ros2 = commands.add_parser("ros2", help="filter as a node of ROS 2, /edgefilter, or extract its recordings")
    option = ros2.add_argument
    sound = "16-bit samples in audio_common_msgs/AudioData"
    option("--mic", default="/audio", metavar="TOPIC", help=f"microphone, {sound} (default: %(default)s)")
    told = "what the robot says or the output plays, in the same form (default: %(default)s)"
    option("--reference", default="/speech", metavar="TOPIC", help=told)
    told = "std_msgs/Empty when the robot was silenced in mid-word (default: %(default)s)"
    option("--silenced", default="/speech_stopped", metavar="TOPIC", help=told)
    option("--human", default="/human", metavar="TOPIC", help="topic for the human (default: %(default)s)")
    option("--profile", metavar="P.npz", help="calibrated robot")
    option("--engine", **ENGINE)
    option("--confirm-s", **CONFIRM)
    option("--false-starts-per-hour", **FALSE_STARTS)
    option("--ask-db", **ASK)
    told = "domain of DDS (default: ROS_DOMAIN_ID, or 0)"
    option("--domain", type=whole(0, 232, "a domain, 0 to 232"), metavar="N", help=told)
    _form(option)
    option("--mic-channels", **MIC_CHANNELS)
    told = "channel of the microphone, from 0, that holds what is played, in place of the reference's topic"
    option("--reference-channel", type=channel, metavar="N", help=told)
    told = "channels of the reference (default: as many as the microphone has)"
    option("--reference-channels", type=eight, metavar="N", help=told)
    words = ros2.add_subparsers(dest="word", metavar="extract")
    option = words.add_parser("extract", help="write two topics of a recording as WAV files").add_argument
    option("recording", metavar="ROBOT.mcap")
    option("--mic", required=True, metavar="TOPIC", help="microphone")
    option("--reference", required=True, metavar="TOPIC", help="what the robot said")
    option("--output", required=True, metavar="DIR", help="folder for mic.wav and reference.wav")
    _form(option)
    option("--json", **JSON)


def _form(option: Callable[..., object]) -> None:
    rate = whole(8000, 48000, "a rate, 8000 to 48000 Hz")
    option("--rate", type=rate, default=16000, metavar="HZ", help="of the samples (default: %(default)s)")
    option("--channels", type=eight, default=1, metavar="N", help="interleaved (default: %(default)s)")


def _profile(commands: argparse._SubParsersAction) -> None:
    profile = commands.add_parser("profile", help="look into a profile")
    show = profile.add_subparsers(dest="word", metavar="show", required=True)
    option = show.add_parser("show", help="print what a profile holds").add_argument
    option("profile", metavar="P.npz")
    option("--plot", metavar="FILE.png", help="draw it")
    option("--json", **JSON)
    option("--effects", **EFFECTS)


def _recording(option: Callable[..., object], profile_needed: bool) -> None:
    """What is read by commands that work on a recording of the robot alone."""
    without = "" if profile_needed else "; without it a profile is made from the recording"
    told = f"calibrated robot, made by 'edgefilter calibrate'{without}"
    option("--profile", required=profile_needed, metavar="P.npz", help=told)
    told = "the robot alone, as the microphone recorded it, some seconds at least"
    option("--recording", required=True, metavar="MIC", help=told)
    option("--reference", required=True, metavar="REF", help="what the robot said, as it was sent to the loudspeaker")
    option("--json", **JSON)
    option("--effects", **EFFECTS)


def _live(option: Callable[..., object], what: str) -> None:
    option("--live", action="store_true", help=what)
    told = "device for --live (default: %(default)s)"
    option("--speaker", default="default", metavar="DEVICE", help=f"output {told}")
    option("--input", default="mic", metavar="DEVICE", help=f"input {told}")


def command(text: str) -> str:
    """Words for a shell, not none."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"'{text}' is not a command")
    return text


def effect_file(text: str) -> str:
    """A Python file whose stem can be the name of an effect."""
    if not text.endswith(".py") or not Path(text).stem.isidentifier() or Path(text).stem in names():
        raise argparse.ArgumentTypeError(
            f"'{text}', expected a .py file whose stem is one word and no known effect's, such as mine.py"
        )
    return text


eight = whole(1, 8, "1 to 8 channels")


def main(argv: list[str] | None = None) -> int:
    """Run one command; every expected failure is one line on standard error."""
    arguments = sys.argv[1:] if argv is None else argv
    debug = "--debug" in arguments
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a pipe gets each line at once; a file name that the terminal's encoding lacks is no reason to stop
        sys.stdout.reconfigure(line_buffering=True, errors="backslashreplace")
    try:
        with nullcontext() if debug else own_words_only():
            command = _load(arguments)  # with the handlers of __main__: an import may swallow KeyboardInterrupt
            with on_signal(_interrupt) as caught:
                try:
                    code = command() or 0
                    sys.stdout.flush()  # what is still buffered fails here, with a reason, or at exit, with a traceback
                finally:
                    if caught:  # also where a library has turned KeyboardInterrupt into an error of its own
                        raise KeyboardInterrupt
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


def _load(arguments: list[str]) -> Callable[[], int | None]:
    """The command that was asked for, with all that it imports."""
    parser = build_parser()
    args = parser.parse_args(arguments)
    if args.command is None:
        return parser.print_help
    check_outputs(args)
    for file in getattr(args, "effects", []):
        load_effect(file)
    return partial(importlib.import_module(f"edgefilter.commands.{args.command}").main, args)


def _interrupt() -> NoReturn:
    """SIGTERM ends a command as Ctrl-C does; `run` and those that serve have an answer of their own."""
    raise KeyboardInterrupt


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
    print(f"edgefilter: {printable(error)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
