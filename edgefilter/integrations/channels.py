"""Which channels of what a program is handed are the microphones of one array, and which one is what is played."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from edgefilter.audio.raw import delivered
from edgefilter.errors import SignalError, UsageError
from edgefilter.types import MOST_MICROPHONES, Samples


def named(
    mic_channels: Sequence[int] | None, reference_channel: int | None = None, there: int | None = None
) -> list[int] | None:
    """Numbers of channels, from 0: the microphones, and last the reference, if it is one of them.

    there: how many channels there are, where that is known. Raises UsageError for no microphones, more than eight, a channel
    that is named twice or is not there, and a reference without microphones.
    """
    if mic_channels is None:
        if reference_channel is not None:
            raise UsageError(f"reference_channel is {reference_channel}, expected mic_channels that name the others")
        return None
    found = list(mic_channels)
    if not 1 <= len(set(found)) == len(found) <= MOST_MICROPHONES or min(found) < 0:
        expected = f"the numbers of one to {MOST_MICROPHONES} different channels, from 0"
        raise UsageError(f"mic_channels is {found}, expected {expected}")
    if reference_channel is not None:
        if reference_channel < 0 or reference_channel in found:
            expected = f"a channel, from 0, beside mic_channels {found}"
            raise UsageError(f"reference_channel is {reference_channel}, expected {expected}")
        found.append(reference_channel)
    if there is not None and max(found) >= there:
        raise UsageError(f"channel {max(found)} is named, found {there} channels, counted from 0: name others")
    return found


def taken(samples: Samples, wanted: Sequence[int]) -> Samples:
    """The one channel that is wanted, (n,), else (n, wanted), of samples (n, channels); raises SignalError where one lacks."""
    if max(wanted) >= samples.shape[1]:
        raise SignalError(
            f"the microphone brings {samples.shape[1]} channels, counted from 0, and channel {max(wanted)} is named:"
            " name others"
        )
    return np.ascontiguousarray(delivered(samples, list(wanted)))


def numbers(text: str) -> list[int]:
    """Channels as a command line names them, with commas between them."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' does not name channels, such as 1,2,3") from None
