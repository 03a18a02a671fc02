"""From one sample rate to another: live sound piece by piece, with little delay; recordings as a whole."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from edgefilter.dsp.fractional_delay import CHUNK
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, Samples

HALF_S = 0.0035
"""Seconds of future samples that the filter kernel needs; with as many its transition band is 630 Hz wide."""
SPARED_HZ = 8000
"""Lowest rate with this reach; below, it grows in proportion, so that no larger part of the band is lost."""
BETA = 6.76
"""Shape of the Kaiser window for 70 dB: 0.1102 (A - 8.7), Oppenheim & Schafer, Discrete-Time Signal Processing, 7.5.3."""
MOST_PHASES = 512
"""Kernels that are tabulated; where the rates have more, lines between two of them err by -80 dB at most."""


RATES = range(1000, 768001)
"""Of recordings, Hz: a file of another has a damaged header."""


def at_16_khz(recording: Samples, sample_rate: int) -> Samples:
    """A recording (n,) or (n, channels) at that rate, converted to 16 kHz; as it is where that is its rate.

    Raises UsageError for a rate that is not among RATES. What else is wrong with it is left to those who take it.
    """
    if sample_rate not in RATES:
        raise UsageError(f"sample_rate is {sample_rate}, expected {RATES[0]} to {RATES[-1]} Hz")
    if sample_rate == SAMPLE_RATE or np.ndim(recording) not in (1, 2):
        return recording
    import soxr  # a learner beside the filter needs its memory more

    return soxr.resample(recording, sample_rate, SAMPLE_RATE, quality="VHQ")


def from_16_khz(recording: Samples, sample_rate: int, size: int) -> Samples:
    """A recording (n,) at 16 kHz converted to that rate, (size,): as long as what was converted before."""
    if sample_rate == SAMPLE_RATE:
        return recording
    import soxr

    converted = soxr.resample(recording, SAMPLE_RATE, sample_rate, quality="VHQ")[:size]
    return np.pad(converted, (0, size - converted.size))


class Resampler:
    """One stream from one rate to another, piece by piece: a band-limited interpolation of linear phase.

    Output k belongs to the time k / target of the input, and comes once the input is `delay_s` further; at equal rates
    there is none. All of it together, after `last`, is as long as the input. Whatever lies above half of the lower rate
    is lowered by 70 dB. source, target: Hz. channels: samples are then (n, channels), where they are more than one.

    >>> down = Resampler(48000, 16000)
    >>> down.push(np.zeros(480, np.float32)).size, down.push(np.zeros(0, np.float32), last=True).size
    (104, 56)
    """

    def __init__(self, source: int, target: int, channels: int = 1) -> None:
        self.rates, self.channels = (source, target), channels
        self._each = [Resampler(source, target) for _ in range(channels)] if channels > 1 else []
        common = math.gcd(source, target)
        self._step, self._phases = source // common, target // common
        self._rows = None if source == target else _kernels(source, target)
        self._reach = 0 if self._rows is None else self._rows.shape[1] // 2
        self.delay_s = self._reach / source
        self._kept = np.zeros(max(self._reach - 1, 0), np.float32)
        self._at = 0

    def push(self, samples: Samples, last: bool = False) -> Samples:
        """Take the next samples (n,) and return the finished ones; after `last` nothing may follow."""
        if self._rows is None:
            return samples
        if self._each:
            return np.stack([one.push(samples[:, at], last) for at, one in enumerate(self._each)], axis=1)
        end = np.zeros(self._reach if last else 0, np.float32)
        kept = np.concatenate((self._kept, samples, end))
        count = max(0, -((self._at - (kept.size - 2 * self._reach + 1) * self._phases) // self._step))
        out = np.empty(count, np.float32)
        for first in range(0, count, CHUNK):
            at = self._at + self._step * np.arange(first, min(first + CHUNK, count))
            out[first : first + CHUNK] = self._interpolate(kept, at)
        self._at += count * self._step
        used = min(self._at // self._phases, kept.size)
        self._at -= used * self._phases
        self._kept = kept[used:].copy()
        return out

    def _interpolate(self, kept: Samples, at: np.ndarray) -> Samples:
        """The values (n,) at positions (n,) in units of one phase."""
        assert self._rows is not None
        whole, phase = np.divmod(at, self._phases)
        windows = np.lib.stride_tricks.sliding_window_view(kept, 2 * self._reach)[whole]
        if self._phases == len(self._rows):
            return np.einsum("ij,ij->i", windows, self._rows[phase])
        below, share = np.divmod(phase * MOST_PHASES, self._phases)
        share = (share / self._phases).astype(np.float32)
        low, high = (np.einsum("ij,ij->i", windows, self._rows[row]) for row in (below, below + 1))
        return low + share * (high - low)


@lru_cache(maxsize=16)
def _kernels(source: int, target: int) -> Samples:
    """One kernel of sum 1 a phase, (phases, taps), or (MOST_PHASES + 1, taps) where there are more phases."""
    phases = target // math.gcd(source, target)
    fractions = np.arange(phases) / phases if phases <= MOST_PHASES else np.linspace(0.0, 1.0, MOST_PHASES + 1)
    low = min(source, target)
    half_s = HALF_S * max(1.0, SPARED_HZ / low)
    reach = math.ceil(half_s * source)
    times = (fractions[:, None] + reach - 1 - np.arange(2 * reach)) / source
    cutoff = low / 2 - 1.1 / half_s  # the middle of the band between, 2.2 / half_s wide, which ends at low / 2
    window = np.i0(BETA * np.sqrt(np.maximum(1.0 - (times / half_s) ** 2, 0.0))) * (np.abs(times) <= half_s)
    rows = np.sinc(2 * cutoff * times) * window
    return (rows / rows.sum(axis=1, keepdims=True)).astype(np.float32)
