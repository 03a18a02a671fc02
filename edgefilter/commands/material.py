"""What compare, diagnose and add work on: a profile, a recording of the robot alone and the reference of what it said.

Without a profile, it is what the recording itself says of the robot.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from edgefilter.audio.reader import Reader
from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.errors import AudioFileError
from edgefilter.profile.data import Profile
from edgefilter.types import Samples


def load(args: argparse.Namespace) -> tuple[Profile, Samples, Samples]:
    """Profile, recording (n,) and reference (m,) of the command line, 16 kHz mono.

    Conversions are said on standard error.

    Without --profile the profile is made from the recording. Raises AudioFileError for a file that is unusable or holds
    only silence, ProfileError for a damaged profile, SignalError where there is no profile and nothing to make one
    from.
    """
    profile = None if args.profile is None else Profile.load(args.profile)
    recording, reference = _read(args.recording, "recording"), _read(args.reference, "reference")
    return profile or self_calibrate(recording, reference), recording, reference


def _read(path: str, role: str) -> Samples:
    reader = Reader(path, role)
    if reader.silent:
        raise AudioFileError(
            f"{role} {path} is silent: every sample is zero, expected the robot's voice; check what was recorded"
        )
    for note in reader.notes:
        print(note, file=sys.stderr)
    return np.concatenate([*reader.chunks(), np.zeros(0, np.float32)])
