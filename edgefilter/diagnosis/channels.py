"""Whether the channels of a recording are the microphones that were calibrated: which is which, how loud, how clean."""

from __future__ import annotations

import numpy as np
from scipy import fft

from edgefilter.dsp.exchange import ALIKE, EQUAL, exchanged, order_of
from edgefilter.dsp.lag import flat_cross
from edgefilter.dsp.tones import SECOND
from edgefilter.errors import SignalError
from edgefilter.filter.microphones import MOST_CLIPPED
from edgefilter.profile.data import Profile
from edgefilter.types import Samples

GAIN_DB = 2.0
"""Beside the others, by which a gain is another one: in another room, or with a hand near it, a microphone changes by less
than 1 dB beside the others."""
TOP, BELOW, CROWDED = 0.998, 0.99, 3
"""Parts of the largest sample: above one a sample is at the top, above the other beside it; and how many times as many at
the top as beside it no sound has: a sine has as many in both, one bent at its top 2.5 times."""


def doubtful_channels(profile: Profile, recordings: Samples, reference: Samples) -> dict[int, str]:
    """What is wrong with microphones, by number, from 0; none where each is as it was calibrated.

    recordings: (microphones, n) float32, the robot alone at each, 16 kHz. reference: (m,), what it said. Raises
    SignalError where the profile holds another number of microphones.
    """
    if len(recordings) != profile.microphones:
        raise SignalError(
            f"the profile holds {profile.microphones} microphones, found {len(recordings)}: name those that were"
            " calibrated with --mic-channels"
        )
    doubts = {}
    for at, one in enumerate(recordings):
        peak, power = float(np.abs(one).max(initial=0.0)), np.mean(np.square(one, dtype=np.float64))
        if not peak:
            doubts[at] = "silent, every sample is 0"
        elif is_clipped(np.abs(one) / peak):
            doubts[at] = f"clipped at {20 * np.log10(peak):.1f} dB of full scale"
        for other in range(at):
            if at not in doubts and np.mean(np.square(one - recordings[other], dtype=np.float64)) < EQUAL * power:
                doubts[at] = f"the same sound as channel {other}"
    if len(doubts) == len(recordings):
        return doubts
    heard, expected = loudest_second(profile, recordings, reference)
    found = order_of(heard, expected)
    if found is None:
        return doubts
    order, lag = found
    doubts |= exchanged(order)
    expected = np.roll(expected, lag, axis=1)
    gains = {}
    for at, one in enumerate(heard):
        theirs = expected[order[at]]
        cross, size = float(np.vdot(one, theirs)), float(np.vdot(theirs, theirs))
        if at in doubts and at == order[at]:
            continue
        if cross < ALIKE * np.sqrt(float(np.vdot(one, one)) * size):
            doubts.setdefault(at, "hears the robot otherwise than it was calibrated: moved, processed, or broken")
        else:
            gains[at] = 20 * np.log10(cross / size)
    middle = float(np.median(list(gains.values()))) if len(gains) > 2 else min(gains.values(), key=abs, default=0.0)
    for at, gain in gains.items():
        if abs(gain - middle) > GAIN_DB and at not in doubts:
            doubts[at] = f"another gain, {gain - middle:+.1f} dB beside the others since the calibration"
    return dict(sorted(doubts.items()))


def is_clipped(size: Samples) -> bool:
    """Whether a sound of which this is the size (n,), the largest of it 1, was cut at its top."""
    top, beside = np.count_nonzero(size > TOP), np.count_nonzero(size > BELOW)
    return bool(top >= MOST_CLIPPED and top > CROWDED * (beside - top))


def loudest_second(profile: Profile, recordings: Samples, reference: Samples) -> tuple[Samples, Samples]:
    """What the microphones heard and what was to be expected, (microphones, SECOND) each, within some samples."""
    paths, n = profile.running_responses(), recordings.shape[1]
    size = fft.next_fast_len(n + reference.size + paths.shape[1] + round(profile.delay), real=True)
    said = np.fft.rfft(reference, size)
    expected = np.fft.irfft(said * np.fft.rfft(paths, size), size)
    cross = sum((flat_cross(one, heard, size) for one, heard in zip(expected, recordings)), np.zeros(1))
    late = int(np.argmax(np.abs(fft.irfft(cross, size))))
    late = late if late < n else late - size
    expected = np.roll(expected, late, axis=1)[:, :n]
    length = min(SECOND, n)
    energy = np.cumsum(np.concatenate(((0.0,), np.square(expected).sum(axis=0))))
    first = int(np.argmax(energy[length:] - energy[:-length]))
    span = slice(first, first + length)
    return recordings[:, span], expected[:, span].astype(np.float32)
