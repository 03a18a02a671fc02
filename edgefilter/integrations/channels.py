"""Which channels of what a program is handed are the microphones of one array."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edgefilter.errors import SignalError, UsageError
from edgefilter.types import MOST_MICROPHONES, Samples


def named(mic_channels: Sequence[int] | None) -> list[int] | None:
    """Numbers of channels, from 0, as they were given; raises UsageError for none, more than eight, or one twice."""
    if mic_channels is None:
        return None
    found = list(mic_channels)
    if not 1 <= len(set(found)) == len(found) <= MOST_MICROPHONES or min(found) < 0:
        raise UsageError(
            f"mic_channels is {found}, expected the numbers of one to {MOST_MICROPHONES} different channels, from 0"
        )
    return found


def microphones(samples: Samples, wanted: Sequence[int]) -> Samples:
    """(n,) of the one channel that is wanted, else (n, wanted), of samples (n, channels); raises SignalError where one lacks."""
    if max(wanted) >= samples.shape[1]:
        raise SignalError(
            f"the microphone brings {samples.shape[1]} channels, found channel {max(wanted)} in mic_channels, counted"
            " from 0: name others"
        )
    return np.ascontiguousarray(samples[:, wanted[0]] if len(wanted) == 1 else samples[:, list(wanted)])
