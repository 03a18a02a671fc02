"""Least-squares filters between two signals: long ones by conjugate gradients, and the spectra that parametric filters are fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.dsp.convolution import convolve
from edgefilter.dsp.fourier import power as power_of
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.recording import BLOCK
from edgefilter.types import SAMPLE_RATE, Array, Samples

SETTLED = 1e-6
"""A step that explains less than this part of what all before it have explained is the last."""
DELAYS = np.arange(-8.0, 8.01, 0.1)
"""Samples by which the lag of a filtered recording may be off: it is found as that of the loudest frequencies."""


def convolve_from(x: Samples, taps: Array, lead: int) -> Samples:
    """Return sum_k taps[k] x(n - k + lead), (n,) float32."""
    y = convolve(x, taps.astype(np.float32))
    return np.pad(y, (0, max(lead + x.size - y.size, 0)))[lead : lead + x.size].astype(np.float32, copy=False)


def fit_filter(
    x: Samples, target: Samples, weights: Samples, taps: int, lead: int, prior: Array | None = None, steps: int = 12
) -> Array:
    """The filter c that minimises sum w(n) (target(n) - sum_k c[k] x(n - k + lead))^2 + sum c^2 / prior, (taps,) float64.

    x, target: (n,), whitened, so that the noise has variance 1. weights: (n,) 0 to 1. prior: (taps,) expected c^2;
    None: no penalty but a tiny one. Preconditioned conjugate gradients on the normal equations (Golub & Van Loan,
    Matrix Computations, 11.5) with a circulant preconditioner; stopping after `steps` leaves out what the data hardly
    speaks of. Not scipy's cg: what a step explains, by which this one stops, can be had from its iterates only as a
    difference, which the transforms' float32 drowns.
    """
    blocks = _Blocks(x, weights, taps, lead)
    share = float(np.mean(weights))
    size = fft.next_fast_len(2 * taps, real=True)
    power = np.maximum(fft.rfft(_windowed(blocks.correlation(), taps, size)).real, 0.0) * max(share, 1e-6)
    penalty = np.full(taps, 1e-9 * float(power.max()) + 1e-12) if prior is None else 1.0 / np.maximum(prior, 1e-12)
    lightest = float(np.min(penalty))
    scale = np.sqrt(lightest / penalty)

    def condition(v: Array) -> Array:
        return scale * fft.irfft(fft.rfft(scale * v, size) / (power + lightest), size)[:taps]

    c = np.zeros(taps)
    left = blocks.adjoint(target)
    turned = condition(left)
    direction, energy = turned.copy(), float(np.dot(left, turned))
    first, explained = energy, 0.0
    for _ in range(steps):
        if energy <= 1e-8 * first:
            break
        image = blocks.normal(direction) + penalty * direction
        step = energy / float(np.dot(direction, image))
        c += step * direction
        explained += step * energy
        if step * energy < SETTLED * explained:
            break
        left -= step * image
        turned = condition(left)
        energy, before = float(np.dot(left, turned)), energy
        direction = turned + energy / before * direction
    return c


def fit_supported(
    x: Samples, target: Samples, weights: Samples, taps: int, lead: int, prior: Array, steps: int
) -> Array:
    """Return fit_filter's answer, or zeros where a filter from half of the weighted samples does not help on the other half (BLOCKs, two by two)."""
    half = np.arange(x.size) // BLOCK % 4 < 2
    trial = convolve_from(x, fit_filter(x, target, weights * half, taps, lead, prior, steps // 2), lead)
    fall = float(np.dot(target * target - (target - trial) ** 2, weights * ~half))
    return fit_filter(x, target, weights, taps, lead, prior, steps) if fall > 0.0 else np.zeros(taps)


class _Blocks:
    """Cut x (n,) into the blocks of a weighted convolution, those without weight left out: overlap-save.

    The blocks are those between two changes of the samples that are fitted on, so that half of them drop out; their
    transforms stay in the cache.
    """

    def __init__(self, x: Samples, weights: Samples, taps: int, lead: int) -> None:
        self._taps = taps
        self._size, self._new = fft.next_fast_len(taps - 1 + BLOCK, real=True), BLOCK
        count = -(-x.size // self._new)
        padded = np.pad(np.asarray(weights, np.float32), (0, count * self._new - x.size)).reshape(count, self._new)
        self._used = np.flatnonzero(padded.any(axis=1))
        self._weights = padded[self._used]
        self._x = x.astype(np.float32)
        after = lead + count * self._new - x.size + self._size
        before = np.concatenate((np.zeros(taps - 1 - lead, np.float32), self._x, np.zeros(after, np.float32)))
        pieces = before[self._used[:, None] * self._new + np.arange(self._size)]
        self._source = fft.rfft(pieces, axis=1)
        self._turned_back = self._source.conj()
        self._moved = np.zeros((self._used.size, self._size), np.float32)

    def correlation(self) -> Array:
        """Autocorrelation of x at lags from 0 on, (taps,)."""
        n = fft.next_fast_len(self._x.size + self._taps, real=True)
        return fft.irfft(np.abs(fft.rfft(self._x, n)) ** 2, n)[: self._taps]

    def adjoint(self, target: Samples) -> Array:
        """Return sum w(n) target(n) x(n - k + lead), (taps,)."""
        whole = np.zeros((int(self._used[-1]) + 1) * self._new if self._used.size else 0, np.float32)
        whole[: target.size] = target[: whole.size]
        return self._correlated(whole.reshape(-1, self._new)[self._used])

    def normal(self, c: Array) -> Array:
        """Adjoint of x filtered by c (taps,), (taps,)."""
        spectrum = fft.rfft(c.astype(np.float32), self._size)
        filtered = fft.irfft(self._source * spectrum, self._size, axis=1, overwrite_x=True)[
            :, self._taps - 1 : self._taps - 1 + self._new
        ]
        return self._correlated(filtered)

    def _correlated(self, signals: Samples) -> Array:
        """The sum over all blocks of signals (blocks, new) times their weights, correlated with x, (taps,)."""
        np.multiply(signals, self._weights, out=self._moved[:, self._taps - 1 : self._taps - 1 + self._new])
        both = np.einsum("bf,bf->f", fft.rfft(self._moved, axis=1), self._turned_back)
        return fft.irfft(both, self._size)[: self._taps].astype(np.float64)


def _windowed(correlation: Array, taps: int, size: int) -> Array:
    """The autocorrelation up to lag taps, tapered, as one period of a circulant (size,)."""
    kept = np.zeros(size)
    taper = 1.0 - np.arange(taps) / taps
    kept[:taps] = correlation[:taps] * taper
    kept[size - taps + 1 :] = (correlation[1:taps] * taper[1:])[::-1]
    return kept


@dataclass(frozen=True, eq=False)
class Spectra:
    """Of the whitened fit samples: frequencies (m,) Hz, auto-spectra of prediction and recording (m,), cross-spectrum (m,) complex.

    fan: what the fan alone has in each on average. averaged: bins of the transform in each.
    """

    hz: Array
    predicted: Array
    cross: NDArray[np.complex128]
    heard: Array
    fan: float
    averaged: int

    def gain(self, response: NDArray[np.complex128]) -> float:
        """By how much the squared error falls when the prediction gets that response (m,) instead of 1."""
        own = np.abs(response) ** 2 * self.predicted - 2.0 * (response.conj() * self.cross).real
        return float(np.sum(self.predicted - 2.0 * self.cross.real) - np.sum(own))


def spectra(measurement: Measurement, white: Samples, resolution_hz: float) -> Spectra:
    """Auto- and cross-spectra of a whitened prediction (n,) and the recording over the fit samples, averaged to resolution_hz."""
    p = white * measurement.weights
    y = measurement.white_recording * measurement.weights
    n = fft.next_fast_len(p.size, real=True)
    a, b = fft.rfft(p.astype(np.float64), n), fft.rfft(y.astype(np.float64), n)
    width = max(int(resolution_hz * n / SAMPLE_RATE), 1)
    count = a.size // width
    auto, cross, own = (
        2.0 / n * x[: count * width].reshape(count, width).sum(axis=1) for x in (power_of(a), b * a.conj(), power_of(b))
    )
    hz = (np.arange(count) + 0.5) * width * SAMPLE_RATE / n - 0.5 * SAMPLE_RATE / n
    return Spectra(hz, auto, cross, own, 2.0 * width / n * float(np.sum(measurement.weights)), width)
