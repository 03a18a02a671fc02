"""Lag of one signal behind another: whitened cross-spectra (GCC-PHAT), their highest correlation and its peak between samples."""

from __future__ import annotations

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d

from edgefilter.dsp.fourier import power
from edgefilter.types import SAMPLE_RATE, Array, Samples

SMOOTHING_HZ = 32.0
"""Width over which the power that a spectrum is divided by is averaged: harmonics are flattened, no pitch peaks."""
LIKELY_HZ = 50.0
"""The same where the prediction's power weighs a cross-spectrum."""
LOWEST_HZ = 100.0
"""A voice and its room begin here; what lies below is rumble."""
ONE_SIGNAL = 0.999
"""Squared correlation coefficient of two signals at lag 0 from which on they are copies of one signal. A microphone's signal
comes some samples later than its reference, with noise and reverberation above -30 dB, and never correlates so highly."""
COPIED = 0.98
"""Correlation of a copy with what it is a copy of, both cut from the same second at a lag of some ms."""


def smoothed_power(spectrum: np.ndarray, width_hz: float) -> Array:
    """Return |spectrum|^2 (..., bins), averaged over width_hz."""
    raw = power(spectrum)
    width = max(round(width_hz * 2 * spectrum.shape[-1] / SAMPLE_RATE), 1)
    return uniform_filter1d(raw, width, output=np.empty_like(raw), mode="nearest")


def flattened(spectrum: np.ndarray, floor: float) -> np.ndarray:
    """The spectrum (bins,) over the root of its smoothed power, which counts as no less than floor times its maximum.

    Two of these, one conjugated, make the phase transform's cross-spectrum (Knapp & Carter 1976), but for the smoothing.
    """
    weight = smoothed_power(spectrum, SMOOTHING_HZ)
    weight += weight.dtype.type(floor * weight.max() + 1e-20)
    return spectrum * (weight.dtype.type(1.0) / np.sqrt(weight, out=weight))


def flat_cross(a: Array, b: Array, n: int) -> np.ndarray:
    """Cross-spectrum of b with a, both flattened, without rumble, (n // 2 + 1,): for unknown signals."""
    first, second = (flattened(fft.rfft(x.astype(np.float64), n), 1e-6) for x in (a, b))
    cross = second * first.conj()
    cross[: int(LOWEST_HZ * n / SAMPLE_RATE)] = 0.0
    return cross


def likely_cross(predicted: Samples, recording: Samples, n: int) -> np.ndarray:
    """Cross-spectrum Y P* / (|P|^2 + N) of prediction P and recording Y, (n // 2 + 1,): flat where the voice is above the noise.

    N is the power of noise of variance 1 in a bin. The maximum-likelihood weighting of Knapp & Carter (1976) where the prediction is
    wrong in proportion to the voice.
    """
    source = fft.rfft(predicted.astype(np.float64), n)
    heard = fft.rfft(recording.astype(np.float64), n)
    return heard * source.conj() / (smoothed_power(source, LIKELY_HZ) + recording.size)


def correlation_near(cross: np.ndarray, n: int, reach: int) -> Array:
    """The correlation at lags -reach to reach of which this is the spectrum, n samples long, (2 reach + 1,)."""
    correlation = fft.irfft(cross, n)
    return np.concatenate((correlation[n - reach :], correlation[: reach + 1]))


def highest(near: Array) -> tuple[int, float]:
    """Lag of the highest value of near (2 reach + 1,), and its height over the root mean square of all."""
    at = int(np.argmax(near))
    return at - near.size // 2, float(near[at]) / max(float(np.sqrt(np.mean(np.square(near)))), 1e-30)


def turn(omega: Array, delay: float) -> np.ndarray:
    """exp(j omega delay), complex64 for a float32 omega; several times as fast as np.exp of a complex array."""
    angle = omega * delay
    turned = np.empty(omega.size, np.complex64 if omega.dtype == np.float32 else np.complex128)
    np.cos(angle, out=turned.real)
    np.sin(angle, out=turned.imag)
    return turned


def climb(cross: np.ndarray, omega: Array, lag: float, steps: int = 8, tolerance: float = 0.0) -> float:
    """The lag, at most one sample from `lag`, at the top of the correlation whose cross-spectrum (bins,) this is.

    omega: (bins,) radians per sample. Newton's method on Re sum cross exp(j omega lag), to a step under the tolerance.
    """
    squared, moved = np.square(omega), 0.0
    for _ in range(steps):
        turned = turn(omega, lag + moved)
        np.multiply(cross, turned, out=turned)
        slope = -float(omega.dot(turned.imag))
        curvature = -float(squared.dot(turned.real))
        if curvature >= 0.0:
            break
        # halfway between two samples a longer step jumps to and fro across the top
        step = min(max(-slope / curvature, -0.5), 0.5)
        moved = min(max(moved + step, -1.0), 1.0)
        if abs(step) < tolerance:
            break
    return lag + moved


def top(cross: np.ndarray, n: int, lag: float) -> float:
    """`climb` for a cross-spectrum (n // 2 + 1,) of n samples, to a ten-thousandth of a sample."""
    return climb(cross, 2 * np.pi * np.arange(cross.size) / n, lag, tolerance=1e-4)


def played_in(heard: Samples, played: Samples) -> bool:
    """Whether what was heard (n,) is what was played (n,), at another level and lag: no room is between them.

    >>> sound = np.random.default_rng(0).standard_normal(4096)
    >>> played_in(0.2 * np.roll(sound, 20), sound), played_in(np.convolve(sound, [1.0, 0.5])[:4096], sound)
    (True, False)
    """
    size = fft.next_fast_len(2 * heard.size, real=True)
    cross = fft.irfft(fft.rfft(heard, size) * fft.rfft(played, size).conj(), size)
    whole = np.sqrt(float(np.vdot(heard, heard)) * float(np.vdot(played, played)))
    return bool(np.abs(cross).max() > COPIED * whole > 0.0)


def one_signal(cross: float, first: float, second: float) -> bool:
    """Whether two signals are the same but for a gain. cross, first, second: sums of their products and of their squares.

    >>> one_signal(2.0, 1.0, 4.0), one_signal(1.9, 1.0, 4.0), one_signal(0.0, 0.0, 0.0)
    (True, False, False)
    """
    return cross**2 > ONE_SIGNAL * first * second
