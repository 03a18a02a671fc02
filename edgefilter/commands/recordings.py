"""The recordings that commands read, and what compare, diagnose and add work on."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from edgefilter.audio.reader import Reader
from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.commands.display import say
from edgefilter.errors import AudioFileError
from edgefilter.profile.data import Profile
from edgefilter.types import Samples


def read(path: str, role: str, channels: Sequence[int] | None = None) -> Samples:
    """A whole recording (n,), 16 kHz mono, which messages call by its role; conversions are said on standard error.

    channels: numbers, from 0, of those that are wanted in place of the mean; (n, channels) of several.

    Raises AudioFileError for a file that is unusable.
    """
    reader = Reader(path, role, channels)
    for note in reader.notes:
        say(note)
    return np.concatenate(list(reader.chunks()))


def load(args: argparse.Namespace) -> tuple[Profile, Samples, Samples]:
    """Profile, recording (n,) of the robot alone and reference (m,) of what it said; 16 kHz mono.

    Without --profile the profile is made from the recording. Raises AudioFileError for a file that is unusable or holds
    only silence, ProfileError for a damaged profile, SignalError where no profile can be made from the recording.
    """
    profile = None if args.profile is None else Profile.load(args.profile)
    recording, reference = _voice(args.recording, "recording"), _voice(args.reference, "reference")
    return profile or self_calibrate(recording, reference), recording, reference


def _voice(path: str, role: str) -> Samples:
    samples = read(path, role)
    if not samples.any():
        raise AudioFileError(
            f"{role} {path} is silent: every sample is zero, expected the robot's voice; check what was recorded"
        )
    return samples
