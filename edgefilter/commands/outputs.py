"""The check, before any work, that no file is both read and written, or written twice, and that each can be written."""

from __future__ import annotations

import argparse
import errno
import os
import stat
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from edgefilter.errors import EdgefilterError, UsageError

RECORDINGS = ("sweep_reference", "sweep_recording", "noise_recording")
"""Of a calibration: its options, and the files that it records."""
MOVING = ("moving_recording", "moving_reference")
"""Further files that a calibration records of a robot that moves."""
READ = ("input", "reference", "play", "profile", "model", "recording", "effects", *RECORDINGS, "while_moving", "token")
"""Options that may name a file to read; a name that is no file, such as a device's, cannot be overwritten."""
WRITTEN = (
    *("output", "excitation", "json", "report", "save_profile", "learn", "apply", "write_effect"),
    *("plot", "log_json"),
)
"""Options that may name a file to write."""
PROFILES = ("output", "save_profile", "learn", "apply")
"""Those of them that name a profile: wherever 'output' is a file that is written in the end, it is one."""
CASES = ("one", "two")
"""The robots of `demo --hidden`, folders of demo_data/hidden: the first has one fault that is not told, the second two."""
HIDDEN_FILES = (
    *("robot.npz", "mic.wav", "tts.wav", "talk.wav", "talk_tts.wav", "better.npz"),
    *("human_before.wav", "human_after.wav", "report.html", "before_after.png"),
)
"""What it writes of each of them."""
FOLDERS: dict[tuple[str, str], tuple[str, ...]] = {
    ("run", "record"): ("mic.wav", "reference.wav", "output.wav", "events.jsonl", "run.json", "profile.npz"),
    ("run", "turns"): ("turn_0001.wav",),
    ("calibrate", "save_input"): tuple(f"{name}.wav" for name in (*RECORDINGS, *MOVING)),
    ("ros2", "output"): ("mic.wav", "reference.wav"),
    ("demo", "output"): (
        *("filtered.wav", "microphone.wav", "human.wav", "interrupted.wav", "before_after.png"),
        *(f"{case}/{name}" for case in CASES for name in HIDDEN_FILES),
    ),
}
"""By command and option: the files that are written into the folder which the option names."""
IN_FOLDERS = ("save_input", "record", "turns")
"""Options that name nothing but a folder."""
PACKAGE = Path(__file__).parent.parent


@dataclass(frozen=True)
class Place:
    """A file that an option names, or standard input or output (stream: its handle). role: how a message names it.

    at_end: it is written when all the work is done, into a folder that has to exist. replaced: it is
    written under another name first, then renamed over what is there.
    """

    role: str
    path: str
    stream: int | None = None
    at_end: bool = False
    replaced: bool = False

    def __str__(self) -> str:
        return f"{self.role} {self.path}"

    def status(self) -> os.stat_result | None:
        """Of a file that writing can destroy; None where there is none, for a pipe, a terminal, a device."""
        try:
            found = os.stat(self.path) if self.stream is None else os.fstat(self.stream)
        except OSError:
            return None
        return found if stat.S_ISREG(found.st_mode) else None

    def name(self) -> str:
        """The path as a file system may see it that ignores case and how letters are composed, links followed."""
        return unicodedata.normalize("NFC", os.path.realpath(self.path)).casefold()


def check_outputs(args: argparse.Namespace) -> None:
    """Refuse the arguments, before anything is touched, where a file to be written is also read, or written twice.

    Files are compared by what they are, not by how they are written: `..`, symbolic and hard links are seen through.
    Raises UsageError for that, and for '-' where standard output cannot be meant; EdgefilterError where a result could
    not be written in the end.
    """
    for option, path in _given(args, *READ, *WRITTEN, *IN_FOLDERS):
        if not path or "\0" in path:
            raise UsageError(
                f"{flag(option)} is {path!r}, which is not the name of a file: give one or leave the option out"
            )
    read, written = list(_read(args)), list(_written(args))
    for number, output in enumerate(written):
        if output.path == "-" and output.stream is None:
            raise UsageError(f"{output} does not name a file: this result cannot go to standard output")
        for given in read:
            if _same(output, given):
                raise UsageError(f"{output} is also an input ({given}) and would be overwritten: choose another file")
        for other in written[:number]:
            if output.stream is not None and other.stream is not None:
                raise UsageError(f"{output} and {other} would mix on standard output: send one of them to a file")
            if _same(output, other) or (
                output.stream is other.stream is None and not _device(output) and output.name() == other.name()
            ):
                raise UsageError(
                    f"{output} and {other} are the same file and one would overwrite the other: choose another file"
                )
    for output in written:
        if output.at_end:
            _check_writable(output)
    for option, path in _given(args, *(option for command, option in FOLDERS if command == args.command)):
        _check_folder(flag(option), path)
    for _, path in _given(args, "record"):  # what failed once may not come again, so an earlier record is kept
        if found := [name for name in FOLDERS["run", "record"] if os.path.lexists(os.path.join(path, name))]:
            raise UsageError(f"--record {path} holds {', '.join(found)} already: name a new folder")


def _given(args: argparse.Namespace, *options: str) -> Iterator[tuple[str, str]]:
    """Each of the options that is given, and what it names; an option that may be given several times has a list."""
    for option in options:
        given = getattr(args, option, None)
        yield from ((option, path) for path in (given if isinstance(given, list) else [given]) if path is not None)


def flag(option: str) -> str:
    return f"--{option.replace('_', '-')}"


def _read(args: argparse.Namespace) -> Iterator[Place]:
    """Every file that the command may read: those that options and the environment name, and the package's own."""
    for option, path in _given(args, *READ):
        yield Place(option.replace("_", " "), path, 0 if path == "-" and option == "input" else None)
    for variable, path in os.environ.items():
        if variable.startswith("EDGEFILTER_"):
            yield Place(variable, path)
    for pattern in ("demo_data/*", "demo_data/hidden/*/*", "models/*", "../models/*"):
        for file in PACKAGE.glob(pattern):
            yield Place("edgefilter's own", str(file))


def _written(args: argparse.Namespace) -> Iterator[Place]:
    for option, path in _given(args, *WRITTEN, *IN_FOLDERS):
        role = flag(option)
        if (args.command, option) == ("probe", "excitation"):
            yield Place(f"{role}, its question", question_of(path), at_end=True)
        for name in FOLDERS.get((args.command, option), ()):
            yield Place(role, os.path.join(path, name))
        if (args.command, option) not in FOLDERS:
            sound = (args.command, option) == ("run", "output")
            to_stdout = path == "-" and (sound or option in ("json", "log_json"))
            at_end = not sound and not to_stdout
            yield Place(role, path, 1 if to_stdout else None, at_end, replaced=option in PROFILES)


def question_of(excitation: str) -> str:
    """Where `probe` writes what it asks with a sound, beside it."""
    return f"{excitation}.json"


def _same(first: Place, second: Place) -> bool:
    found, other = first.status(), second.status()
    return found is not None and other is not None and os.path.samestat(found, other)


def _device(place: Place) -> bool:
    """Whether it exists and is nothing that writing destroys."""
    return os.path.exists(place.path) and place.status() is None


def _check_writable(place: Place) -> None:
    """Raise EdgefilterError where writing is bound to fail, so that it is said before minutes of work, not after."""
    folder = os.path.dirname(os.path.realpath(place.path))
    if os.path.isdir(place.path):
        why = os.strerror(errno.EISDIR)
    elif not os.path.isdir(folder):
        why = os.strerror(errno.ENOTDIR if os.path.exists(folder) else errno.ENOENT)
    elif not os.access(place.path if os.path.exists(place.path) else folder, os.W_OK):
        why = os.strerror(errno.EACCES)
    elif place.replaced and _device(place):
        why = "a file cannot replace it"
    else:
        return
    raise EdgefilterError(
        f"{place} cannot be written: {why}; name a file in a folder that exists and can be written to"
    )


def _check_folder(role: str, path: str) -> None:
    """Raise EdgefilterError where a folder neither is nor can be made, before other outputs are begun."""
    above = os.path.realpath(path)
    while not os.path.lexists(above):
        above = os.path.dirname(above)
    if not os.path.isdir(above):
        raise EdgefilterError(f"{role} {path} cannot be made: {above} is no folder; name another")
    if not os.access(above, os.W_OK):
        raise EdgefilterError(f"{role} {path} cannot be made or written: {os.strerror(errno.EACCES)}; name another")
