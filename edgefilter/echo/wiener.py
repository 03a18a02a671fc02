"""Least-squares filters between two signals: long ones by conjugate gradients, and the spectra that parametric filters are fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.echo.effect import Measurement
from edgefilter.types import SAMPLE_RATE, Array, Samples


def convolve_from(x: Samples, taps: Array, lead: int) -> Samples:
    """sum_k taps[k] x(n - k + lead), (n,) float32."""
    n = fft.next_fast_len(x.size + taps.size, real=True)
    return fft.irfft(fft.rfft(x, n) * fft.rfft(taps.astype(np.float32), n), n)[lead : lead + x.size].astype(np.float32)


def fit_filter(x: Samples, target: Samples, weights: Samples, taps: int, lead: int, prior: Array | None = None, steps: int = 12) -> Array:
    """(taps,) float64, the filter c that minimises sum w(n) (target(n) - sum_k c[k] x(n - k + lead))^2 + sum c^2 / prior.

    x, target: (n,), whitened, so that the noise has variance 1. weights: (n,) 0 to 1. prior: (taps,) expected c^2; None: no penalty
    but a tiny one. Preconditioned conjugate gradients on the normal equations (Golub & Van Loan, Matrix Computations, 11.5) with a
    circulant preconditioner; stopping after `steps` leaves out what the data hardly speaks of.
    """
    n = fft.next_fast_len(x.size + taps, real=True)
    source = fft.rfft(x.astype(np.float32), n)
    share = float(np.mean(weights))
    size = fft.next_fast_len(2 * taps, real=True)
    correlation = fft.irfft(np.abs(source) ** 2, n)
    power = np.maximum(fft.rfft(_windowed(correlation, taps, size)).real, 0.0) * max(share, 1e-6)
    penalty = np.full(taps, 1e-9 * float(power.max()) + 1e-12) if prior is None else 1.0 / np.maximum(prior, 1e-12)
    lightest = float(np.min(penalty))
    scale = np.sqrt(lightest / penalty)

    def adjoint(signal_: Array) -> Array:
        moved = np.zeros(n, np.float32)
        moved[: x.size] = signal_ * weights
        return np.take(fft.irfft(fft.rfft(moved) * source.conj(), n), np.arange(-lead, taps - lead), mode="wrap")

    def forward(c: Array) -> Array:
        padded = np.zeros(n, np.float32)
        padded[: taps - lead], padded[n - lead :] = c[lead:], c[:lead]
        return fft.irfft(fft.rfft(padded) * source, n)[: x.size]

    def condition(v: Array) -> Array:
        return scale * fft.irfft(fft.rfft(scale * v, size) / (power + lightest), size)[:taps]

    c = np.zeros(taps)
    left = adjoint(target)
    turned = condition(left)
    direction, energy = turned.copy(), float(np.dot(left, turned))
    first = energy
    for _ in range(steps):
        if energy <= 1e-8 * first:
            break
        image = adjoint(forward(direction)) + penalty * direction
        step = energy / float(np.dot(direction, image))
        c += step * direction
        left -= step * image
        turned = condition(left)
        energy, before = float(np.dot(left, turned)), energy
        direction = turned + energy / before * direction
    return c


def fit_supported(x: Samples, target: Samples, weights: Samples, taps: int, lead: int, prior: Array, steps: int) -> Array:
    """fit_filter's answer, or zeros where a filter from half of the weighted samples does not help on the other half (blocks of 0.5 s)."""
    half = np.arange(x.size) // (SAMPLE_RATE // 2) % 4 < 2
    trial = convolve_from(x, fit_filter(x, target, weights * half, taps, lead, prior, steps // 2), lead)
    fall = float(np.dot(target * target - (target - trial) ** 2, weights * ~half))
    return fit_filter(x, target, weights, taps, lead, prior, steps) if fall > 0.0 else np.zeros(taps)


def _windowed(correlation: Array, taps: int, size: int) -> Array:
    """The autocorrelation up to lag taps, tapered, as one period of a circulant (size,)."""
    kept = np.zeros(size)
    taper = 1.0 - np.arange(taps) / taps
    kept[:taps] = correlation[:taps] * taper
    kept[size - taps + 1 :] = (correlation[1:taps] * taper[1:])[::-1]
    return kept


@dataclass(frozen=True, eq=False)
class Spectra:
    """Of the whitened fit samples: frequencies (m,) Hz, auto-spectrum of the prediction (m,), cross-spectrum to the recording (m,) complex."""

    hz: Array
    predicted: Array
    cross: NDArray[np.complex128]

    def gain(self, response: NDArray[np.complex128]) -> float:
        """By how much the squared error falls when the prediction gets that response (m,) instead of 1."""
        own = np.abs(response) ** 2 * self.predicted - 2.0 * (response.conj() * self.cross).real
        return float(np.sum(self.predicted - 2.0 * self.cross.real) - np.sum(own))


def spectra(measurement: Measurement, predicted: Samples, resolution_hz: float) -> Spectra:
    """Auto- and cross-spectra of predicted (n,) and the recording over the fit samples, averaged to resolution_hz."""
    p = measurement.whiten(predicted) * measurement.weights
    y = measurement.whiten(measurement.recording) * measurement.weights
    n = fft.next_fast_len(p.size, real=True)
    a, b = fft.rfft(p.astype(np.float64), n), fft.rfft(y.astype(np.float64), n)
    width = max(int(resolution_hz * n / SAMPLE_RATE), 1)
    count = a.size // width
    auto, cross = (np.abs(a[: count * width]) ** 2).reshape(count, width), (b * a.conj())[: count * width].reshape(count, width)
    hz = (np.arange(count) + 0.5) * width * SAMPLE_RATE / n - 0.5 * SAMPLE_RATE / n
    return Spectra(hz, 2.0 * auto.sum(axis=1) / n, 2.0 * cross.sum(axis=1) / n)
