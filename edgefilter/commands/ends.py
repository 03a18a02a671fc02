"""The two ends of a run by what people type: files, pipes and sound devices."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

from edgefilter.audio import virtual
from edgefilter.audio.files import open_sink, open_source
from edgefilter.audio.protocols import Sink, Source
from edgefilter.audio.reader import Reader
from edgefilter.audio.speech import SpokenReference
from edgefilter.audio.steady import SteadySink
from edgefilter.errors import UsageError

FILE_ENDINGS = (".wav", ".flac", ".ogg", ".mp3", ".aiff", ".aif", ".w64", ".opus", ".txt", ".raw", ".pcm")


def make_speech(args: argparse.Namespace) -> SpokenReference | None:
    """What the run itself is to play, None where nothing was asked for."""
    live = args.input != "-" and not looks_like_file(args.input)
    if args.play is None:
        if args.speaker is not None or args.barge_in:
            option = "--barge-in" if args.barge_in else "--speaker"
            raise UsageError(f"{option} concerns the speech that --play plays, found none: give --play FILE")
        return None
    if not live or args.reference is not None:
        found = f"--reference {args.reference}" if live else f"--input {args.input}"
        raise UsageError(
            f"--play plays the robot's speech to a live microphone and is the reference itself, found {found}: give"
            " --input mic and no --reference"
        )
    from edgefilter.audio.device import speaker

    return speaker(args.speaker, Reader(args.play, "speech"))


def make_source(name: str, reference: str | SpokenReference | None, output: str) -> Source:
    """A file or pipe where name is one, else the live devices.

    The reference defaults to the monitor of the output device, for the virtual microphone to that of its speaker.
    """
    if isinstance(reference, str | None) and (name == "-" or looks_like_file(name)):
        return open_source(name, reference)
    virtual.refuse_own(name)
    from edgefilter.audio.device import monitor_of
    from edgefilter.audio.live import LiveSource

    if isinstance(reference, str) and looks_like_file(reference):
        raise UsageError(
            f"live, the reference is a device, found the file {reference}: leave --reference out or name a monitor"
            " ('edgefilter devices'); to play the file, --play"
        )
    if reference is not None:
        return LiveSource(name, reference, patience_s=math.inf)
    own = virtual.speaker_monitor() if output == virtual.HUMAN else None
    played_on = "default" if output in ("-", virtual.HUMAN) or looks_like_file(output) else output
    return LiveSource(name, own or monitor_of(played_on), patience_s=math.inf)


def make_sink(name: str, latency: int, wait: bool) -> Sink:
    """A file or pipe where name is one, else an output device, which gets the latency as silence first.

    wait: let a device that plays slower hold back the source, which a recording can bear and a microphone cannot.
    """
    if name == "-" or looks_like_file(name):
        return open_sink(name)
    from edgefilter.audio.live import LiveSink

    if wait:
        return LiveSink(name, latency, wait=True)
    return SteadySink(lambda: LiveSink(name, latency, wait=False))


def looks_like_file(name: str) -> bool:
    """Whether people who type this mean a file: it exists, has an audio ending, or has a folder in it."""
    return Path(name).exists() or name.lower().endswith(FILE_ENDINGS) or "/" in name


def limited(source: Source, limit: int | None) -> Iterator:
    """The blocks of source up to limit samples; the last one is cut."""
    left = limit
    for block in source:
        if left is not None and block.mic.size >= left:
            source.stop()
            yield type(block)(block.mic[:left], block.ref[:left], block.start, block.lost)
            return
        left = None if left is None else left - block.mic.size
        yield block
