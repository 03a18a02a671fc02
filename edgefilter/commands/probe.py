"""`edgefilter probe`: where several explanations of a recording remain, what tells them apart is played, and its recording says which is right."""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from edgefilter.audio.files import FileSink
from edgefilter.commands.calibrate import take
from edgefilter.commands.display import print_result, progress, write_json
from edgefilter.commands.outputs import question_of
from edgefilter.commands.recordings import load, read, read_voice
from edgefilter.diagnosis.candidates import RIVAL, remaining
from edgefilter.diagnosis.probe import ENOUGH, SOUND_S, Answer, Inquiry
from edgefilter.diagnosis.recording import Recording
from edgefilter.echo.effects.catalogue import find
from edgefilter.errors import AudioFileError, SignalError, UsageError
from edgefilter.profile.data import Profile
from edgefilter.report.text import add_command, files_given, joined

SCHEMA = 1
"""Of the question beside a sound."""


def main(args: argparse.Namespace) -> None:
    if args.live == bool(args.excitation):
        raise UsageError("expected one of --live, to play here, and --excitation S.wav, to play elsewhere")
    if args.seconds < SOUND_S:
        raise UsageError(f"--seconds is {args.seconds:g}, expected at least {SOUND_S:g}, which is one sound")
    wanted = [tuple(text.split("+")) for text in args.explanation]
    for name in (name for effects in wanted for name in effects):
        find(name)
    if args.reference is None:
        _evaluate(args)
        return
    recording = load(args)
    with progress("explanations that remain") as step:
        if not wanted:
            wanted = list(remaining(recording.diagnose(progress=step).tried))
        inquiry = _inquiry(recording, wanted)
    print_result(args, [f"asked       {joined(one.name for one in inquiry.explanations)}: which of them it is"])
    if args.excitation:
        _write(args, inquiry)
    else:
        answer = inquiry.ask(lambda sound: take(args, sound.samples, f"now playing: {sound.words}"), args.seconds)
        _tell(args, answer, vars(args))


def _inquiry(recording: Recording, wanted: list[tuple[str, ...]]) -> Inquiry:
    """Two explanations or more, fitted. Raises SignalError where there is nothing to ask."""
    if not wanted:
        raise SignalError("nothing to ask: the diagnosis names nothing that another recording would show")
    first, *others = ["+".join(effects) for effects in wanted]
    if not others:
        raise SignalError(
            f"nothing to ask: {first} is named, and no other effect explains {100 * RIVAL:.0f} % of what it does"
        )
    inquiry = recording.probe(wanted)
    if len(inquiry.explanations) < 2:
        raise SignalError(f"nothing to ask: {joined([first, *others])} predict the same, under other names")
    return inquiry


def _write(args: argparse.Namespace, inquiry: Inquiry) -> None:
    """The best sounds one after the other, and beside them what is asked."""
    with progress("the sounds that tell them apart") as step:
        chosen = inquiry.sounds(np.ones(len(inquiry.explanations)), step)[: int(args.seconds / SOUND_S)]
    with FileSink(args.excitation) as sink:
        for sound in chosen:
            sink.write(sound.samples)
    question = {
        "schema": SCHEMA,
        "explanations": [one.name for one in inquiry.explanations],
        "sounds": [sound.words for sound in chosen],
        "recording": str(Path(args.recording).resolve()),
        "reference": str(Path(args.reference).resolve()),
        "excitation_sha256": _digest(args.excitation),
        "profile_sha256": _digest(args.profile),
    }
    write_json(question, question_of(args.excitation))
    files = "".join(f" --{role} {shlex.quote(getattr(args, role))}" for role in ("profile", "excitation"))
    own = "".join(f" --effects {shlex.quote(file)}" for file in args.effects)
    lines = [
        f"play        {args.excitation}, {len(chosen) * SOUND_S:g} s: {joined(sound.words for sound in chosen)}",
        "record      what the microphone hears of it, and a second more",
        f"next        edgefilter probe{files}{own} --recording ANSWER.wav",
    ]
    print_result(args, lines, question)


def _evaluate(args: argparse.Namespace) -> None:
    """What was recorded of a sound that was written: which explanation it speaks for."""
    if args.live or args.explanation:
        raise UsageError("without --reference a recording of --excitation is evaluated: give --reference to ask anew")
    profile, question = Profile.load(args.profile), _question(args)
    sound, answer = read(args.excitation, "excitation"), read_voice(args.recording, "recording")
    recording, reference = (read_voice(question[role], role) for role in ("recording", "reference"))
    with progress("the answer"):
        wanted = [tuple(text.split("+")) for text in question["explanations"]]
        inquiry = _inquiry(Recording(recording, reference, profile), wanted)
        heard = inquiry.hear(answer, sound)
        told = inquiry.answer([heard], [inquiry.gains(sound)], tuple(question["sounds"]))
    _tell(args, told, {**vars(args), **question, "profile": args.profile})


def _question(args: argparse.Namespace) -> dict[str, Any]:
    """What was asked with the sound. Raises AudioFileError where this is not the sound, or the profile, that it was asked with."""
    path, again = question_of(args.excitation), "write it again with --recording and --reference"
    try:
        question: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
        schema, digests = question["schema"], {role: question[f"{role}_sha256"] for role in ("excitation", "profile")}
    except (OSError, ValueError, TypeError, KeyError):
        raise AudioFileError(
            f"{path} is not there or holds no question: {args.excitation} is no sound that probe wrote; {again}"
        ) from None
    if schema != SCHEMA:
        raise AudioFileError(f"{path} has schema {schema}, expected {SCHEMA}: {again}")
    for role, digest in digests.items():
        if _digest(getattr(args, role)) != digest:
            raise AudioFileError(f"{role} {getattr(args, role)} is not the one that {path} was written with; {again}")
    return question


def _digest(path: str) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise AudioFileError(f"{path} cannot be read: {error.strerror}") from None


def _tell(args: argparse.Namespace, answer: Answer, names: dict[str, Any]) -> None:
    """Which it is, or what is left and what to do then."""
    seconds = len(answer.sounds) * SOUND_S
    chance = f"{answer.odds:.0f}" if answer.odds < 1000 else "more than 1000"
    shares = ", ".join(f"{one.name} {100 * weight:.3g} %" for one, weight in answer.ranked)
    lines = [f"played      {words}" for words in answer.sounds]
    if answer.settled:
        lines += [f"it is       {answer.first.name}, {chance} to 1 ({shares})"]
        lines += [f"next        {add_command(answer.first.effects, names)}"]
    elif answer.odds >= ENOUGH:
        lines += [f"nearest     {answer.first.name}, {chance} to 1 ({shares})"]
    elif answer.likely[-1] == answer.likely.max():
        lines += [
            "none        of them predicts what was heard; was anything else heard, or is the path another by now?"
        ]
    else:
        lines += [f"open        {shares}: not {ENOUGH:.0f} to 1 after {seconds:g} s; ask for more with --seconds"]
    if not answer.holds:
        left = f"{answer.first.name} leaves {answer.left_db:.1f} dB over the noise floor"
        where = "of what was heard of the sounds" if answer.in_answer else "of the recording"
        lines += [f"but         {left} {where}: something else is there, or is it none of these?"]
        lines += [f"next        {_closer_look(args, answer, names)}"]
    print_result(args, lines, {"schema": SCHEMA, **answer.to_dict(), "seconds": seconds})


def _closer_look(args: argparse.Namespace, answer: Answer, names: dict[str, Any]) -> str:
    """The command that looks at the recording in which the nearest explanation leaves most; one that was not kept is made again."""
    if not answer.in_answer:
        return f"edgefilter diagnose {files_given(names)}"
    if args.live:
        explanations = " ".join(one.name for one in answer.explanations)
        return f"edgefilter probe {explanations} {files_given(names)} --excitation probe.wav"
    return f"edgefilter diagnose {files_given({**names, 'recording': args.recording, 'reference': args.excitation})}"
