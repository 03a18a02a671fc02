"""Which channels of a recording, a device or a stream are the microphones, and which one is what is played."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgefilter.audio.raw import delivered
from edgefilter.errors import EdgefilterError, SignalError, UsageError
from edgefilter.types import MOST_MICROPHONES, Samples


@dataclass(frozen=True)
class Channels:
    """Numbers, from 0, of channels; where no Channels are given, the mean of all is taken.

    mics: the microphones of one array, one to eight, in the order in which they are delivered; None: all that there are.
    reference: the channel beside them that holds what is played. Raises UsageError for a channel that is named twice or
    below 0, for no microphones or too many, and for a reference without them.
    """

    mics: Sequence[int] | None = None
    reference: int | None = None

    def __post_init__(self) -> None:
        if self.mics is None:
            if self.reference is not None:
                raise UsageError(f"reference_channel is {self.reference}, expected mic_channels that name the others")
            return
        mics = list(self.mics)
        if not 1 <= len(set(mics)) == len(mics) <= MOST_MICROPHONES or min(mics) < 0:
            expected = f"the numbers of one to {MOST_MICROPHONES} different channels, from 0"
            raise UsageError(f"mic_channels is {mics}, expected {expected}")
        if self.reference is not None and (self.reference < 0 or self.reference in mics):
            expected = f"a channel, from 0, beside mic_channels {mics}"
            raise UsageError(f"reference_channel is {self.reference}, expected {expected}")

    @classmethod
    def named(
        cls, mics: Channels | Sequence[int] | None, reference: int | None = None, there: int | None = None
    ) -> Channels | None:
        """What two arguments or options name, of so many that are there, if that is known; None where neither names any."""
        if mics is None and reference is None:
            return None
        if isinstance(mics, Channels):
            found = mics if reference is None else cls(mics.mics, reference)
        else:
            found = cls(mics, reference)
        if there is not None:
            found.among(there, "the microphone")
        return found

    @classmethod
    def parse(cls, text: str) -> Channels:
        """Microphones as a command line names them, with commas between them, or 'all'; raises ArgumentTypeError."""
        if text.strip() == "all":
            return cls()
        try:
            return cls([int(part) for part in text.split(",")])
        except (UsageError, ValueError):
            expected = f"one to {MOST_MICROPHONES} different channels, such as 1,2,3"
            raise argparse.ArgumentTypeError(f"'{text}' does not name {expected}") from None

    def __str__(self) -> str:
        """The microphones as `parse` takes them."""
        return "all" if self.mics is None else ",".join(map(str, self.mics))

    def among(self, there: int, what: str, error: type[EdgefilterError] = UsageError) -> list[int]:
        """Return the channel numbers from 0, the reference's last, for a source with so many channels.

        what: the source, for messages. Raises UsageError where 'all' are more than eight, `error` where a named one is missing.
        """
        if self.mics is None:
            if there > MOST_MICROPHONES:
                expected = f"at most {MOST_MICROPHONES} microphones: name them with --mic-channels"
                raise UsageError(f"{what} has {there} channels, expected {expected}")
            return list(range(there))
        found = [*self.mics, *([] if self.reference is None else [self.reference])]
        if max(found) >= there:
            has = f"{there} channels, 0 to {there - 1}" if there > 1 else "channel 0 alone"
            raise error(f"{what} has {has}, found channel {max(found)} asked for: choose others with --mic-channels")
        return found

    def taken(self, samples: Samples) -> Samples:
        """Of samples (n, channels) the one that is wanted, (n,), else (n, wanted); raises SignalError where one lacks."""
        wanted = self.among(samples.shape[1], "the microphone", SignalError)
        return np.ascontiguousarray(delivered(samples, wanted))
