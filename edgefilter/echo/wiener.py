"""Least-squares filters between two signals: long ones by conjugate gradients, and the spectra that parametric filters are fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.fourier import power as power_of
from edgefilter.echo.measurement import Measurement, VoiceModel
from edgefilter.echo.recording import BLOCK
from edgefilter.types import SAMPLE_RATE, Array, Samples

SETTLED = 1e-6
"""A step that explains less than this part of what all before it have explained is the last."""
DELAYS = np.arange(-80.0, 81.0) / 10.0
"""Samples by which the lag of a filtered recording may be off: it is found as that of the loudest frequencies."""
LONGEST = 12800
"""Taps of the longest filter that is fitted, 0.8 s: the decay by 60 dB of an office, by 40 dB of a hall."""


def fit_filter(
    x: Samples,
    target: Samples,
    weights: Samples,
    taps: int,
    lead: int,
    prior: Array | None = None,
    steps: int = 12,
    start: Array | None = None,
) -> Array:
    """The filter c that minimises sum w(n) (target(n) - sum_k c[k] x(n - k + lead))^2 + sum c^2 / prior, (taps,) float64.

    x, target: (n,), whitened, so that the noise has variance 1. weights: (n,) 0 to 1. prior: (taps,) expected c^2;
    None: no penalty but a tiny one. start: (taps,), what is known of it; None: nothing. Preconditioned conjugate gradients on
    the normal equations (Golub & Van Loan, Matrix Computations, 11.5) with a circulant preconditioner; stopping after `steps`
    leaves out what the data hardly speaks of. Not scipy's cg, whose iterates do not tell what a step explains: float32 drowns the difference.
    """
    blocks = _Blocks(x, weights, taps, lead)
    share = float(np.mean(weights))
    size = fft.next_fast_len(2 * taps, real=True)
    power = np.maximum(fft.rfft(_circulant(x.astype(np.float32), taps, size)).real, 0.0) * max(share, 1e-6)
    penalty = np.full(taps, 1e-9 * float(power.max()) + 1e-12) if prior is None else 1.0 / np.maximum(prior, 1e-12)
    lightest = float(np.min(penalty))
    scale = np.sqrt(lightest / penalty)

    def condition(v: Array) -> Array:
        return scale * fft.irfft(fft.rfft(scale * v, size) / (power + lightest), size)[:taps]

    c, left = np.zeros(taps), blocks.adjoint(target)
    if start is not None:
        c, left = start.copy(), left - blocks.normal(start) - penalty * start
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


def fit_supported(x: Samples, target: Samples, weights: Samples, lead: int, prior: Array) -> Array:
    """fit_filter's answer; zeros where a filter from half of the samples does not help on the other half (BLOCKs, two by two)."""
    half, taps = np.arange(x.size) // BLOCK % 4 < 2, prior.size
    trial = filtered(x, fit_filter(x, target, weights * half, taps, lead, prior, steps=8), lead)
    fall = float(np.dot(target * target - (target - trial) ** 2, weights * ~half))
    return fit_filter(x, target, weights, taps, lead, prior, steps=20) if fall > 0.0 else np.zeros(taps)


class _Blocks:
    """x (n,) in the BLOCKs of a weighted convolution, overlap-save: those that are not fitted on drop out."""

    def __init__(self, x: Samples, weights: Samples, taps: int, lead: int) -> None:
        self._taps, self._size = taps, fft.next_fast_len(taps - 1 + BLOCK, real=True)
        self._new = slice(taps - 1, taps - 1 + BLOCK)
        count = -(-x.size // BLOCK)
        padded = np.pad(np.asarray(weights, np.float32), (0, count * BLOCK - x.size)).reshape(count, BLOCK)
        self._used = np.flatnonzero(padded.any(axis=1))
        self._weights = padded[self._used]
        around = np.pad(x.astype(np.float32), (taps - 1 - lead, lead + count * BLOCK - x.size + self._size))
        self._source = fft.rfft(around[self._used[:, None] * BLOCK + np.arange(self._size)], axis=1)
        self._turned_back = self._source.conj()
        self._moved = np.zeros((self._used.size, self._size), np.float32)

    def adjoint(self, target: Samples) -> Array:
        """Return sum w(n) target(n) x(n - k + lead), (taps,)."""
        whole = np.zeros((int(self._used[-1]) + 1) * BLOCK if self._used.size else 0, np.float32)
        whole[: target.size] = target[: whole.size]
        return self._correlated(whole.reshape(-1, BLOCK)[self._used])

    def normal(self, c: Array) -> Array:
        """Adjoint of x filtered by c (taps,), (taps,)."""
        spectrum = fft.rfft(c.astype(np.float32), self._size)
        filtered = fft.irfft(self._source * spectrum, self._size, axis=1, overwrite_x=True)
        return self._correlated(filtered[:, self._new])

    def _correlated(self, signals: Samples) -> Array:
        """The sum over all blocks of signals (blocks, BLOCK) times their weights, correlated with x, (taps,)."""
        np.multiply(signals, self._weights, out=self._moved[:, self._new])
        both = np.einsum("bf,bf->f", fft.rfft(self._moved, axis=1), self._turned_back)
        return fft.irfft(both, self._size)[: self._taps].astype(np.float64)


def _circulant(x: Samples, taps: int, size: int) -> Array:
    """Autocorrelation of x (n,) up to lag taps, tapered, as one period of a circulant (size,)."""
    n = fft.next_fast_len(x.size + taps, real=True)
    tapered = fft.irfft(np.abs(fft.rfft(x, n)) ** 2, n)[:taps] * (1.0 - np.arange(taps) / taps)
    kept = np.zeros(size)
    kept[:taps] = tapered
    kept[size - taps + 1 :] = tapered[:0:-1]
    return kept


@dataclass(frozen=True, eq=False)
class Spectra:
    """Of the whitened fit samples: frequencies (m,) Hz, auto-spectra of prediction and recording and cross-spectrum, (m,).

    fan: mean power of the fan alone at each frequency. averaged: bins of the transform that were averaged into each frequency.
    """

    hz: Array
    predicted: Array
    cross: NDArray[np.complex128]
    heard: Array
    fan: float
    averaged: int

    def earlier(self, delays: Array) -> Array:
        """The cross-spectrum with a recording that is so many samples (d,) earlier, real parts before imaginary ones, (2 m, d)."""
        turned = self.cross[:, None] * np.exp(2j * np.pi * np.outer(self.hz, delays) / SAMPLE_RATE)
        return np.concatenate((turned.real, turned.imag))


def spectra(measurement: Measurement, model: VoiceModel, resolution_hz: float = 20.0) -> Spectra:
    """Auto- and cross-spectra of a model's whitened prediction and the recording over the fit samples, averaged over bands of resolution_hz."""
    n = fft.next_fast_len(measurement.recording.size, real=True)
    whole = measurement.once(_spectra, model)
    width = max(int(resolution_hz * n / SAMPLE_RATE), 1)
    count = whole[0].size // width
    auto, cross, own = (2.0 / n * x[: count * width].reshape(count, width).sum(axis=1) for x in whole)
    hz = (np.arange(count) + 0.5) * width * SAMPLE_RATE / n - 0.5 * SAMPLE_RATE / n
    return Spectra(hz, auto, cross, own, 2.0 * width / n * float(np.sum(measurement.weights)), width)


def _spectra(measurement: Measurement, model: VoiceModel) -> tuple[Array, NDArray[np.complex128], Array]:
    """In each bin, of the whitened fit samples: power of the prediction, cross-spectrum, power of the recording."""
    signals = measurement.predicted(model)[1], measurement.white_recording
    n = fft.next_fast_len(signals[0].size, real=True)
    a, b = (fft.rfft((x * measurement.weights).astype(np.float64), n) for x in signals)
    return power_of(a), b * a.conj(), power_of(b)
