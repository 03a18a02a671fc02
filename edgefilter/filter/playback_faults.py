"""A playback at another speed than the reference's: 44.1 kHz taken for 48 kHz."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.frames import rise
from edgefilter.dsp.lag import correlation_near, flat_cross, highest
from edgefilter.types import SAMPLE_RATE, Samples

SPEEDS = (48.0 / 44.1, 44.1 / 48.0)
"""Played faster by 8.8 %, and slower by 8.1 %: of the usual rates these alone differ by less than a third, and by so little
that a listener may not notice."""
LENGTH, REACH, FADE = round(2.5 * SAMPLE_RATE), SAMPLE_RATE, 1024
"""Samples of the microphone that are compared, lags on each side, and samples of fading at both ends."""
STANDS_OUT, AHEAD = 15.0, 1.5
"""Height of the correlation's peak over the rms of all lags, and over the peak at the right speed, from which on a speed is
believed. Robots of other voices in 668 pairs reach 12.4 by chance; those played at the wrong speed have 15 to 72."""


def other_speed(mic: Samples, ref: Samples) -> float | None:
    """The speed of SPEEDS at which the microphone holds the reference; None where it does not, or at the right one.

    mic: (LENGTH,). ref: (LENGTH * SPEEDS[0],) or more from the same moment on.

    >>> rng = np.random.default_rng(0)
    >>> ref = np.convolve(rng.standard_normal(LENGTH + 4000), np.ones(4), "same").astype(np.float32)
    >>> heard = np.interp(np.arange(LENGTH) / SPEEDS[1], np.arange(ref.size), np.roll(ref, 300)).astype(np.float32)
    >>> other_speed(ref[:LENGTH], ref), round(other_speed(heard, ref), 3)
    (None, 1.088)
    """
    peaks = {}
    for speed in (1.0, *SPEEDS):
        played = np.interp(np.arange(LENGTH) * speed, np.arange(ref.size), ref)
        cross = flat_cross(_faded(played), _faded(mic), 2 * LENGTH)
        peaks[speed] = highest(np.abs(correlation_near(cross, 2 * LENGTH, REACH)))[1]
    found = max(SPEEDS, key=lambda speed: peaks[speed])
    return found if peaks[found] > max(STANDS_OUT, AHEAD * peaks[1.0]) else None


def _faded(x: Samples) -> Samples:
    """The signal (n,) with soft ends: two hard cuts would correlate with one another."""
    edge = rise(FADE)
    return x * np.concatenate((edge, np.ones(x.size - 2 * FADE), edge[::-1]))
