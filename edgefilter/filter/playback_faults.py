"""A playback at another speed than the reference's, as of 44.1 kHz that are taken for 48 kHz."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import uniform_filter1d

from edgefilter.alignment.belief import REACH
from edgefilter.alignment.coarse_lag import RANGE
from edgefilter.dsp import fourier
from edgefilter.dsp.frames import frames
from edgefilter.dsp.psd import hann
from edgefilter.types import SAMPLE_RATE, Array, Samples

STEP, STEPS = 0.01, 16
"""Step between neighbouring speeds, and between neighbouring bins, as natural logarithm, so that one speed moves a spectrum by one
bin; and the number of speeds on each side of 1: 17 % either way."""
LENGTH, AHEAD = (round(s * SAMPLE_RATE) for s in (2.5, 0.5))
BEHIND = REACH
"""Samples of the microphone that are compared, and by how much it may be ahead of the reference and behind it."""
CHANCE, CLEAR = 0.35, 0.5
"""Clearness that chance reaches, and by how much the summed clearness of the looks that agree on a speed must exceed that of the looks
that have found a speed of 1. Of 2035 looks at real recordings of humans, and of robots beside the reference of another recording,
the highest 1 % reach .34, the highest of all .56. Of 22 real recordings played 3 % slower one look reaches 1.7 in the median."""
FRAME, HOP = 2048, 512
BINS_HZ = 200.0 * np.exp(STEP * np.arange(340))
"""Up to 6 kHz."""
FORMANTS = 30
"""Bins of the moving mean that is subtracted from the logarithm of a spectrum, so that harmonics are left."""
ASIDE = 8
"""Frames of lag on each side of the best score that belong to the same peak. Of speeds three do, since a harmonic is 3 % wide."""


def speeds(mic: Samples, ref: Samples) -> Iterator[tuple[float, float] | None]:
    """Compare at one speed after the other, None after each; at last the speed at which the microphone holds the reference, and how clearly.

    mic: (LENGTH,). ref: (BEHIND + LENGTH + AHEAD,), from BEHIND samples before the microphone's first on. A voice that is played
    faster has all frequencies higher by one ratio: in a spectrum over their logarithm it has moved, and each frame comes sooner.
    How clearly: the correlation of the spectra at that speed and its best lag, times its ratio to that at any other, less CHANCE.

    >>> rng = np.random.default_rng(0)
    >>> said = np.sin(np.cumsum(np.repeat(rng.uniform(0.1, 0.8, 60), 1600))).astype(np.float32)
    >>> heard = np.interp(BEHIND - 2000 + 1.08 * np.arange(LENGTH), np.arange(said.size), said).astype(np.float32)
    >>> *_, (speed, clear) = speeds(heard, said)
    >>> round(speed, 2), clear > CLEAR
    (1.08, True)
    """
    heard, said = _harmonics(mic), _harmonics(ref)
    size, lags = 2 * said.shape[0], said.shape[0] - round(heard.shape[0] * np.exp(STEP * STEPS))
    spectra = np.conj(fourier.rfft(np.ascontiguousarray(np.pad(said, ((0, size - said.shape[0]), (0, 0))).T)))
    energy = np.cumsum(np.pad(np.square(said).sum(axis=1, dtype=np.float64), (1, 0)))
    scores = np.empty((2 * STEPS + 1, lags))
    yield None
    for step, score in zip(range(-STEPS, STEPS + 1), scores, strict=True):
        # the microphone's spectra as they would be at a speed of 1: stretched in time, and moved by so many bins
        at = np.arange(round(heard.shape[0] * np.exp(STEP * step))) * np.exp(-STEP * step)
        slower = np.zeros((size, heard.shape[1]), np.float32)
        first, last = max(step, 0), heard.shape[1] + min(step, 0)
        moved = _between(heard[:, first:last], at)
        slower[: at.size, first - step : last - step] = moved
        cross = (fourier.rfft(np.ascontiguousarray(slower.T)) * spectra).sum(axis=0)
        # logarithms of spectra: where any sound overlaps, its energy is thousands
        overlap = (energy[at.size :] - energy[: energy.size - at.size])[:lags]
        correlation = np.roll(fourier.irfft(cross, size)[::-1], 1)[:lags]
        score[:] = correlation / np.sqrt(np.square(moved).sum() * (overlap + 0.1 * overlap.max()) + 1.0)
        yield None
    yield _best(scores)


def _best(scores: Array) -> tuple[float, float]:
    """Speed of the highest of the scores (speeds, lags), and how clear it is."""
    step, lag = np.unravel_index(scores.argmax(), scores.shape)
    elsewhere = scores.copy()
    elsewhere[max(step - 3, 0) : step + 4, max(lag - ASIDE, 0) : lag + ASIDE + 1] = 0.0
    peak, between = scores[step, lag], 0.0  # over what chance has elsewhere at least, where hardly anything sounds
    if 0 < step < 2 * STEPS:
        low, high = scores[step - 1, lag], scores[step + 1, lag]
        between = 0.5 * (low - high) / min(low - 2.0 * peak + high, -1e-20)
    return float(np.exp(STEP * (step - STEPS + between))), max(
        float(peak * peak / max(elsewhere.max(), CHANCE**2)) - CHANCE, 0.0
    )


def _harmonics(x: Samples) -> Samples:
    """Logarithm of each frame's spectrum, less its envelope over frequency and less each bin's mean over time, (frames, bins)."""
    power = fourier.power(fourier.rfft(frames(x, FRAME, HOP) * hann(FRAME).astype(np.float32)))
    read = _between(power.T, BINS_HZ * FRAME / SAMPLE_RATE).T
    found = np.log(read + np.float32(RANGE) * read.max() + fourier.TINY)
    found -= uniform_filter1d(found, FORMANTS, axis=1)
    found -= found.mean(axis=0)
    loudness = power.sum(axis=1)
    return found * (loudness > 1e-3 * loudness.max())[:, None]


def _between(rows: Array, at: Array) -> Array:
    """Linear interpolation between rows (n, m) at fractional positions (k,), (k, m)."""
    whole = np.minimum(at.astype(int), rows.shape[0] - 2)
    part = (at - whole).astype(np.float32)[:, None]
    return (1.0 - part) * rows[whole] + part * rows[whole + 1]


def other_rates(speed: float) -> str:
    """Which usual rates are taken for one another where a sound is played at that speed; nothing where none are.

    >>> other_rates(1.09), other_rates(1.05)
    (': sound sampled at 44.1 kHz seems to be played at 48 kHz, or 22.05 at 24', '')
    """
    for given, taken in (((44.1, 22.05), (48, 24)), ((48, 24), (44.1, 22.05))):
        if abs(np.log(speed * given[0] / taken[0])) < STEP:
            return f": sound sampled at {given[0]:g} kHz seems to be played at {taken[0]:g} kHz, or {given[1]:g} at {taken[1]:g}"
    return ""
