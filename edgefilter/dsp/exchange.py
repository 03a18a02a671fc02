"""Whether channels were exchanged, what each one hears held against what every one is expected to hear, or are copies."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy import fft

from edgefilter.dsp.fourier import power
from edgefilter.types import SAMPLE_RATE, Array, Samples

REACH = 16
"""Samples of lag that all channels may have in common: what the reference's delay is known to, and more than .3 m."""
BAND_HZ = (300.0, 7000.0)
"""Band that is compared: below 300 Hz the microphones of one robot, close together, record nearly the same."""
CLEARER = 0.1
"""By how much more another order of the channels must agree with what is expected: in six simulated offices, microphones 4 cm
around, the right order agrees to .75 to .92 with a calibration made elsewhere in the room, exchanged ones .15 to .7 less."""
EQUAL = 1e-3
"""Power of the difference of two channels, over that of one, up to which they are copies: -30 dB allows for rounding and for a converter."""
ALIKE = 0.3
"""Least agreement, of 1, with which the best order says anything: the robot is heard at all."""


def order_of(heard: Samples, expected: Samples) -> tuple[list[int], int] | None:
    """For each channel of heard (channels, n) the one of expected (channels, n) that it is, and by how many samples all are later.

    None where that cannot be told. Every frequency is weighed the same (Knapp & Carter 1976).

    >>> rng = np.random.default_rng(0)
    >>> one = rng.standard_normal(8192)
    >>> expected = np.stack([np.roll(one, at) for at in (0, 2, 3)])
    >>> order_of(expected[[0, 2, 1]], expected), order_of(0.1 * expected, expected)
    (([0, 2, 1], 0), ([0, 1, 2], 0))
    """
    n = heard.shape[1]
    band, turns = _lags(n)
    ours, theirs = (fft.rfft(x.astype(np.float32), axis=1)[:, band] for x in (heard, expected))
    flat = 1.0 / np.sqrt(power(ours).mean(axis=0) * power(theirs).mean(axis=0) + 1e-30)
    cross = np.einsum("if,jf,f->ijf", ours, theirs.conj(), flat)
    size = [np.sqrt(np.einsum("if,f->i", power(x), flat)) for x in (ours, theirs)]
    alike = (cross.reshape(-1, cross.shape[2]) @ turns).real.reshape(*cross.shape[:2], -1)
    alike = alike / (size[0][:, None, None] * size[1][None, :, None] + 1e-30)
    kept = np.einsum("iil->l", alike) / len(heard)
    own, lag, order = float(kept.max()), int(np.argmax(kept)), list(range(len(heard)))
    best = own
    for at in range(alike.shape[2]):
        found, columns = _best_order(alike[:, :, at])
        if found > max(best, own + CLEARER):
            best, lag, order = found, at, columns
    return (order, lag - REACH) if best > ALIKE else None


def exchanged(order: Sequence[int]) -> dict[int, str]:
    """What is to be said of those that are other channels than they should be, by number, of an order that `order_of` found."""
    wrong = {at: other for at, other in enumerate(order) if at != other}
    return {at: f"exchanged: it hears the robot as channel {other} was calibrated to" for at, other in wrong.items()}


def _best_order(alike: Array) -> tuple[float, list[int]]:
    """The mean of alike (rows, columns) in the best order of the columns that exchanges of two lead to, and this order."""
    order = np.arange(len(alike))
    while True:
        ordered = alike[:, order]
        kept = ordered.diagonal()
        gain = ordered + ordered.T - kept - kept[:, None]
        first, second = np.unravel_index(int(np.argmax(gain)), gain.shape)
        if not gain[first, second] > 1e-6:
            return float(kept.mean()), [int(one) for one in order]
        order[[first, second]] = order[[second, first]]


@lru_cache(maxsize=4)
def _lags(n: int) -> tuple[slice, Array]:
    """The bins of BAND_HZ of an FFT of n samples, and their exp(j omega lag) for lags of -REACH to REACH samples, (bins, 2 REACH + 1)."""
    band = slice(*(round(hz * n / SAMPLE_RATE) for hz in BAND_HZ))
    omega = 2 * np.pi * np.arange(band.start, band.stop) / n
    return band, np.exp(1j * omega[:, None] * np.arange(-REACH, REACH + 1)).astype(np.complex64)
