"""When a residual is loud: at the moments of knocks, or wherever the voice is. And how loud it is then at each frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.fourier import power
from edgefilter.dsp.frames import frames, stretch
from edgefilter.dsp.psd import GRID_BINS, floored, frequencies, hann
from edgefilter.echo.effect import NEVER_REACHED
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

Rises: TypeAlias = tuple[NDArray[np.integer], Samples, Samples]
"""Samples (k,) at which a displacement rises, and the displacement before each and there, (k,)."""
FRAME, HOP, BANDS = 128, 64, 16
"""Frames of 8 ms every 4 ms, in bands of 500 Hz: short enough for single knocks."""
BAND_HZ = SAMPLE_RATE / 2 / BANDS
RESONANCES_HZ, Q = (120.0, 160.0, 210.0, 280.0, 370.0), 1.0
"""Of the membranes whose displacement is tried as the trigger."""
SHARES = (0.3, 0.45, 0.6, 0.7, 0.8, 0.88, 0.94)
"""Thresholds to try, as the share of the displacement's peaks that stay below."""
DECAYS_MS = (4.0, 1.0, 2.0, 8.0, 16.0, 32.0)
"""Of what follows a knock: the first is taken while the trigger is looked for."""
BETTER, LEAST = 3.0, 150.0
"""By how many times more of the log likelihood knocks must explain than noise that follows the voice's level; and how much,
in nats, on samples that they were not learnt from."""
FOLD = SAMPLE_RATE
"""Samples of the stretches that take turns in that."""
ROUNDS = 4
"""Updates of the colours in the search for a trigger; thrice as many to compare, four times to report."""


@dataclass(frozen=True)
class Trigger:
    """What sets off knocks: a displacement through a resonance that exceeds threshold outward (side 1), inward (-1) or either way (0)."""

    resonance_hz: float
    q: float
    threshold: float
    side: float


def find_trigger(
    x: Samples, residual: Samples, predicted: Samples, fit: NDArray[np.bool_] | None
) -> tuple[Trigger | None, bool]:
    """The trigger whose knocks explain best when the whitened residual (n,) is loud, and whether the voice's level explains it less well.

    x (n,): the drive. predicted (n,): the whitened voice. The residual's power in a cell of time and frequency is taken as
    exponentially distributed around a constant plus what each source adds, in a colour of its own: maximum likelihood by
    the multiplicative updates of Fevotte, Bertin & Durrieu 2009 ("Nonnegative matrix factorization with the
    Itakura-Saito divergence", eq. 2.22, with the exponent 1/2 that makes them monotonic).
    """
    power, voice = band_power(residual), band_power(predicted)
    use = frames_to_fit(fit, len(power))
    folds = [use & (_middles(len(power)) // FOLD % 2 == parity) for parity in (0, 1)]
    if min(fold.sum() for fold in folds) < 4 * BANDS:
        return None, False
    one = np.ones((len(power), 1), np.float32)
    seen = power[use]
    best: tuple[float, Trigger | None, Samples] = (-np.inf, None, one)
    for resonance in RESONANCES_HZ:
        moved = resonated(x, resonance, Q)
        thresholds = quantiles_of_peaks(moved)
        sides = rises(moved, min(thresholds))
        for threshold in thresholds:
            outward, inward = (_roughly_ringing(knocks_in(rising, threshold), x.size) for rising in sides)
            for side in (1.0, -1.0, 0.0):
                source = one_side((outward, inward), side)
                source = source / (source.mean() + np.float32(1e-30))
                sources = [one[use], source[use]]
                likelihood = _likelihood(seen, sources, _colours(seen, sources, ROUNDS))
                if likelihood > best[0]:
                    best = (likelihood, Trigger(resonance, Q, threshold, side), source)
    if best[1] is None:
        return None, False
    smoothed = scipy.signal.lfilter([0.2], [1.0, -0.8], voice, axis=0).astype(np.float32)
    nothing, by_knocks, by_voice = (
        _crossed(power, sources, folds) for sources in ([one], [one, best[2]], [one, voice, smoothed])
    )
    return best[1], by_knocks - nothing > max(BETTER * (by_voice - nothing), LEAST)


def frames_to_fit(fit: NDArray[np.bool_] | None, count: int) -> NDArray[np.bool_]:
    """Which of so many frames have their middle among the samples to fit on (n,), None for all; (count,)."""
    return np.ones(count, bool) if fit is None else fit[_middles(count)]


def _middles(count: int) -> NDArray[np.integer]:
    return np.arange(count) * HOP + FRAME // 2


def colour_of(power: Samples, source: Array, use: NDArray[np.bool_]) -> tuple[float, Array]:
    """How likely a residual's band_power() is over frames to use, and (BANDS,) what a source (frames, 1 or BANDS) adds to each band of it, at 1."""
    scale = source.mean(axis=0)
    if not scale.all():
        return -np.inf, np.zeros(BANDS)
    sources = [np.ones((len(power), 1), np.float32)[use], (source / scale)[use].astype(np.float32)]
    colours = _colours(power[use], sources, 4 * ROUNDS)
    return _likelihood(power[use], sources, colours), colours[1] / scale


def fan_in_bands(noise_psd: Samples | None) -> Array:
    """Power of the fan in each band, by which a whitened power is multiplied, (BANDS,): of its density the harmonic mean.

    noise_psd: (601,); None for a fan of variance 1, white.
    """
    fan = np.full(GRID_BINS, 2.0 / SAMPLE_RATE) if noise_psd is None else floored(noise_psd)
    return np.bincount(_band_of_bins()) / np.bincount(_band_of_bins(), 1.0 / fan) * BAND_HZ


def density_of(power: float | Array) -> Array:
    """Spectral density per Hz, of integral 1, of noise with that power in each band, one number or (BANDS,), (601,)."""
    each = np.broadcast_to(np.asarray(power, float), (BANDS,)) + 1e-30
    return (each / each.sum() / BAND_HZ)[_band_of_bins()]


def _band_of_bins() -> NDArray[np.integer]:
    """The band in which each bin of a density lies, (601,)."""
    return np.minimum(frequencies(GRID_BINS) / BAND_HZ, BANDS - 1).astype(int)


def resonated(x: Samples, resonance_hz: float, q: float, sample_rate: int = SAMPLE_RATE) -> Samples:
    """Displacement of a membrane with that resonance for the drive x (n,), in its full scale, (n,)."""
    k = np.pi * resonance_hz / sample_rate  # by the bilinear transform
    square, loss = k * k, k / q
    poles = np.array([1.0 + loss + square, 2.0 * square - 2.0, 1.0 - loss + square])
    return scipy.signal.lfilter(np.array([1.0, 2.0, 1.0]) * square, poles, x).astype(np.float32)


def find_knocks(moved: Samples, threshold: float) -> tuple[Samples, Samples]:
    """Two pulse trains (n,) for a displacement (n,): where it rises above threshold, and where it falls below -threshold.

    The height is the speed over threshold, per millisecond.
    """
    outward, inward = np.zeros_like(moved), np.zeros_like(moved)
    for train, rising in zip((outward, inward), rises(moved, threshold), strict=True):
        at, height = knocks_in(rising, threshold)
        train[at] = height
    return outward, inward


def rises(moved: Samples, least: float) -> list[Rises]:
    """All rises of a displacement (n,) to above `least`, outward and inward: the knocks of any higher threshold are among them."""
    both = [(x, 1 + np.flatnonzero((x[1:] > least) & (x[1:] > x[:-1]))) for x in (moved, -moved)]
    return [(at, x[at - 1], x[at]) for x, at in both]


def knocks_in(rising: Rises, threshold: float) -> tuple[NDArray[np.integer], Samples]:
    """Samples (k,) and heights (k,) of the knocks among rises: they are few."""
    at, before, there = rising
    crossed = (there > threshold) & (before <= threshold)
    return at[crossed], (there - before)[crossed] * np.float32(SAMPLE_RATE / 1000 / threshold)


def one_side(trains: tuple[Array, Array], side: float) -> Array:
    """What belongs to a side, of the trains outward and inward, (n,): 1, -1, or 0 for both."""
    outward, inward = trains
    return outward if side > 0.0 else inward if side < 0.0 else outward + inward


def quantiles_of_peaks(moved: Samples) -> list[float]:
    """The values that each of SHARES of the peaks of |moved| (n,) stays below; peaks under 5 % of the largest do not count."""
    size = np.abs(moved)
    peaks = size[1:-1][(size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])]
    peaks = peaks[peaks > 0.05 * peaks.max()] if peaks.size else peaks
    heights = np.quantile(peaks, SHARES) if peaks.size else np.full(len(SHARES), NEVER_REACHED)
    return np.clip(heights, 1e-5, NEVER_REACHED).tolist()


def ringing_of(knocks: Samples, decay_ms: float, sample_rate: int = SAMPLE_RATE) -> Samples:
    """Squared heights of knocks (n,) as they are heard, PRE_ROLL samples later, decaying by 1/e in decay_ms; (n,)."""
    keep = np.exp(-1.0 / (decay_ms * 1e-3 * sample_rate))
    heard = stretch(knocks, -PRE_ROLL, knocks.size - PRE_ROLL).astype(np.float64)
    return scipy.signal.lfilter([1.0], [1.0, -keep], heard**2).astype(np.float32)


def band_power(x: Samples) -> Samples:
    """Mean power of x (n,) in each band but for the lowest bin, 1 for white noise of variance 1, (frames, BANDS)."""
    window = hann(FRAME).astype(np.float32)
    bins = power(scipy.fft.rfft(frames(x, FRAME, HOP) * window, axis=1)[:, 1:]) / np.sum(window**2)
    return bins.reshape(len(bins), BANDS, -1).mean(axis=2).astype(np.float32)


def _roughly_ringing(knocks: tuple[NDArray[np.integer], Samples], size: int) -> Samples:
    """About what ringing_of() gives, (frames, 1), for knocks (places, heights) in size samples, whose power is summed by hops."""
    at, height = knocks
    count = size // HOP
    hops = np.bincount((at + PRE_ROLL) // HOP, np.square(height, dtype=np.float64), count)[:count]
    keep = np.exp(-HOP / (DECAYS_MS[0] * 1e-3 * SAMPLE_RATE))
    rung = scipy.signal.lfilter([1.0], [1.0, -keep], hops)
    return (rung[:-1] + rung[1:]).astype(np.float32)[:, None]


def _colours(power: Samples, sources: Sequence[Samples], rounds: int) -> list[Samples]:
    """How much of each source (t, 1 or BANDS) is in each band of power (t, BANDS), (BANDS,)."""
    colours = [
        np.full(BANDS, 1.0 if i == 0 else 0.3, np.float32) / max(float(source.mean()), 1e-12)
        for i, source in enumerate(sources)
    ]
    for _ in range(rounds):
        inverse = 1.0 / _expected(sources, colours)
        surprise = power * inverse * inverse
        changes = [(_over_time(s, surprise) + 1e-12) / (_over_time(s, inverse) + 1e-9) for s in sources]
        colours = [colour * np.sqrt(change) for colour, change in zip(colours, changes, strict=True)]
    return colours


def _over_time(source: Samples, power: Samples) -> Samples:
    """The sum of source (t, 1 or BANDS) times power (t, BANDS), (BANDS,)."""
    return (source.T @ power)[0] if source.shape[1] == 1 else np.sum(source * power, axis=0)


def _expected(sources: Sequence[Samples], colours: Sequence[Samples]) -> Samples:
    return sum(source * colour for source, colour in zip(sources, colours, strict=True)) + np.float32(1e-6)


def _likelihood(power: Samples, sources: Sequence[Samples], colours: Sequence[Samples]) -> float:
    expected = _expected(sources, colours)
    return -float(np.sum(np.log(expected) + power / expected))


def _crossed(power: Samples, sources: Sequence[Samples], folds: Sequence[NDArray[np.bool_]]) -> float:
    """Log likelihood of each fold with the colours learnt from the other."""
    total = 0.0
    for learnt, seen in (folds, folds[::-1]):
        colours = _colours(power[learnt], [s[learnt] for s in sources], 3 * ROUNDS)
        total += _likelihood(power[seen], [s[seen] for s in sources], colours)
    return total
