"""`edgefilter probe`: where several explanations of a recording remain, the sound that tells them apart, and the odds once it was heard."""

from __future__ import annotations

import argparse

from edgefilter.audio.files import FileSink
from edgefilter.commands.display import countdown, print_result, progress, say
from edgefilter.commands.recordings import load, read
from edgefilter.diagnosis.probe import SOUND_S, Explanation, Sound, best_sound, remaining, settled, weighed
from edgefilter.errors import UsageError
from edgefilter.profile.data import Profile
from edgefilter.types import Samples


def main(args: argparse.Namespace) -> int:
    if args.live == bool(args.excitation):
        raise UsageError(
            "found neither or both of --live and --excitation FILE: play the sound here, or write it to a file"
        )
    if args.answer and not args.excitation:
        raise UsageError("found --answer without --excitation, the sound that it answers to: give both")
    profile, recording, reference = load(args)
    with progress("explanations that remain") as step:
        found = remaining(profile, recording, reference, step)
    sound = best_sound(profile, found, reference) if len(found) > 1 else None
    lines: list[str] = []
    if sound and args.answer:
        found = weighed(profile, found, read(args.excitation, "excitation"), read(args.answer, "answer"))
    elif sound and args.live:
        found, lines = _live(args, profile, found, sound, reference)
    elif sound:
        with FileSink(args.excitation) as sink:
            sink.write(sound.samples)
        lines = [
            f"play        {sound.words}: {SOUND_S:g} s of sound written to {args.excitation}; record it and give --answer"
        ]
    figures = {
        "schema": 1,
        "settled": len(found) < 2 or settled(found),
        "explanations": [{"effects": list(each.effects), "weight": round(each.weight, 4)} for each in found],
        "sound": sound.words if sound else None,
    }
    print_result(args, [*lines, *_told(found)], figures)
    return 0


def _live(
    args: argparse.Namespace, profile: Profile, found: tuple[Explanation, ...], sound: Sound, reference: Samples
) -> tuple[tuple[Explanation, ...], list[str]]:
    """Sounds played and recorded here, each the best one by then, until the question is settled or the time is over."""
    from edgefilter.audio.measure import play_and_record

    played: list[str] = []
    while not settled(found) and (len(played) + 1) * SOUND_S <= args.seconds:
        sound = best_sound(profile, found, reference)
        heard = play_and_record(args.speaker, args.input, sound.samples, tell=countdown(f"now playing: {sound.words}"))
        if heard.holes:
            say(f"the recording has holes ({heard.holes}): that sound tells nothing")
        else:
            found = weighed(profile, found, sound.samples, heard.samples)
        played.append(f"played      {sound.words}")
    return found, played


def _told(found: tuple[Explanation, ...]) -> list[str]:
    """The explanations with their odds, and whether the question is settled."""
    if len(found) < 2:
        what = found[0].name if found else "nothing that lasts"
        return [f"settled     {what}: nothing else explains the recording nearly as well"]
    lines = [f"  {each.name:<40} {100 * each.weight:5.1f} %" for each in found]
    if settled(found):
        return [f"settled     {found[0].name}", *lines]
    return ["open        these explanations remain", *lines]
