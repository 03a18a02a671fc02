"""The recordings that commands read, and what compare, diagnose and add work on."""

from __future__ import annotations

import argparse

import numpy as np

from edgefilter.audio.channels import Channels
from edgefilter.audio.reader import Reader
from edgefilter.commands.display import say
from edgefilter.diagnosis.channels import doubtful_channels
from edgefilter.diagnosis.recording import Recording
from edgefilter.errors import AudioFileError, UsageError
from edgefilter.profile.array import ArrayCalibration
from edgefilter.profile.data import Profile
from edgefilter.types import Samples


def read(path: str, role: str, channels: Channels | None = None) -> Samples:
    """A whole recording (n,), 16 kHz mono, which messages call by its role; conversions are said on standard error.

    channels: those that are wanted in place of the mean; (n, channels) of several. Raises
    AudioFileError for a file that is unusable.
    """
    return _whole(Reader(path, role, channels))


def _whole(reader: Reader) -> Samples:
    for note in reader.notes:
        say(note)
    return np.concatenate(list(reader.chunks()))


def load(args: argparse.Namespace) -> Recording:
    """The recording of the robot alone, what it said, and the profile.

    Without --profile the profile is made from the recording. Raises AudioFileError for a file that is unusable or holds
    only silence, ProfileError for a damaged profile, SignalError where no profile can be made from the recording.
    """
    profile = None if args.profile is None else Profile.load(args.profile)
    recording, reference = read_voice(args.recording, "recording"), read_voice(args.reference, "reference")
    return Recording(recording, reference, profile)


def load_array(args: argparse.Namespace) -> tuple[Recording, ArrayCalibration | None, dict[int, str]]:
    """As load, of the microphone --channel of the recording's --mic-channels; the profile is of this microphone alone.

    And what the whole profile holds of the others, and what is wrong with any, by channel. Raises as load, SignalError for
    a profile of other microphones, UsageError for a channel that is none of them.
    """
    reader = Reader(args.recording, "recording", args.mic_channels)
    wanted = reader.wanted or []
    number = wanted[0] if args.channel is None else args.channel
    if number not in wanted:
        there = ", ".join(map(str, wanted))
        raise UsageError(f"--channel {number} is none of the microphones {there} of --mic-channels")
    at = wanted.index(number)
    if at and args.apply:
        raise UsageError(
            "--apply writes the profile of the first microphone and the others' beside it: leave --channel out"
        )
    reference = read_voice(args.reference, "reference")
    recordings = _whole(reader).reshape(-1, len(wanted)).T
    if not recordings[at].any():
        raise AudioFileError(f"channel {number} of {args.recording} is silent: every sample is zero, choose another")
    if args.profile is None:
        return Recording(recordings[at], reference), None, {}
    profile, recordings = Profile.load(args.profile), np.ascontiguousarray(recordings)
    doubts = doubtful_channels(profile, recordings, reference)
    found = {wanted[index]: what for index, what in doubts.items()}
    return Recording(recordings[at], reference, profile.of_microphone(at)), profile.array, found


def read_voice(path: str, role: str) -> Samples:
    """A whole recording (n,) as `read` gives it; raises AudioFileError where every sample is zero."""
    samples = read(path, role)
    if not samples.any():
        raise AudioFileError(
            f"{role} {path} is silent: every sample is zero, expected the robot's voice; check what was recorded"
        )
    return samples
