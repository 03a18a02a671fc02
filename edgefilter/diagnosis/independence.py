"""Whether what a model leaves of a recording is white and independent of the reference: correlations with 99 % bounds.

The two tests of a model's residual that System Identification Toolbox shows as `resid` (Ljung 1999, section 16.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.dsp.convolution import convolve
from edgefilter.dsp.fourier import log_response
from edgefilter.dsp.psd import floored
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

PER_MS = SAMPLE_RATE // 1000
CHANCE = Criteria.false_rate
"""Probability with which independent signals are called dependent: of a whole range of lags, as of one."""
BOUND = 2.5758
"""Standard errors that 99 of 100 correlations of independent signals keep within."""
CROSS_MS = (-25, 100)
"""Lags of the cross-correlation behind the direct sound: what comes later is a room, told by the excess by lag. The
autocorrelation goes as far as it does ahead of the sound: three periods of a deep voice."""
ZONES_MS = (
    (CROSS_MS[0], -1.0, "feedback or mis-alignment"),
    (-1.0, 3.0, "the voice's first arrival, changed"),
    (3.0, CROSS_MS[1], "a path that the model has not got"),
)
"""Before the direct sound, at it, behind it, and what a dependence means there. An error of less than a sample of its lag
reaches 1 ms before it; behind it the voice's own colour, which the whitened reference lacks and the residual has, rings
for some ms, and hides what comes as early."""
ORDER, RIDGE = 64, 0.03
"""Of the linear prediction that whitens the reference, 4 ms; and what is added to its power to invert what is left."""
LEAST = SAMPLE_RATE
"""Samples of the robot's voice, and of its silences, without which there is no test."""
SPAN = 6144
"""Samples that are correlated at once."""


@dataclass(frozen=True, eq=False)
class Correlogram:
    """Correlation by lag, (k,) each: values, what independent signals have, and how far from it 99 of 100 are."""

    lags_ms: Array
    values: Array
    expected: Array
    bounds: Array

    @property
    def outside(self) -> float:
        """Part of the lags beyond their bounds; 0.01 by chance."""
        return float(np.mean(np.abs(self.values - self.expected) > self.bounds))

    @property
    def largest(self) -> int:
        """Index of the lag that is furthest beyond its bounds."""
        return int(np.argmax(np.abs(self.values - self.expected) / self.bounds))

    @property
    def dependent(self) -> bool:
        """Whether one of the lags is further off than chance takes the furthest of so many (Bonferroni)."""
        most = -scipy.special.ndtri(0.5 * CHANCE / self.values.size) / BOUND
        at = self.largest
        return bool(abs(self.values[at] - self.expected[at]) > most * self.bounds[at])

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {**{name: np.round(array, 5).tolist() for name, array in vars(self).items()}, **self.summary()}

    def summary(self) -> dict[str, object]:
        """The figures that are said in words."""
        at = self.largest
        return {
            "outside": round(self.outside, 4),
            "dependent": self.dependent,
            "largest": round(float(self.values[at]), 5),
            "largest_at_ms": round(float(self.lags_ms[at]), 4),
        }


@dataclass(frozen=True, eq=False)
class Zone:
    """A range of lags of the cross-correlation; share: part of what is left that a filter of the reference explains."""

    low_ms: float
    high_ms: float
    meaning: str
    share: float
    part: Correlogram

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        place = {"low_ms": self.low_ms, "high_ms": self.high_ms, "meaning": self.meaning}
        return {**place, "share": round(self.share, 4), **self.part.summary()}


@dataclass(frozen=True, eq=False)
class Independence:
    """The autocorrelation of a residual, its cross-correlation with the reference, and the latter by ranges of lags.

    seconds: of the robot's voice that they were taken from. Both signals at 16 kHz, the whole band.
    """

    autocorrelation: Correlogram
    cross_correlation: Correlogram
    zones: tuple[Zone, ...]
    seconds: float

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {
            "seconds": round(self.seconds, 3),
            "autocorrelation": self.autocorrelation.to_dict(),
            "cross_correlation": self.cross_correlation.to_dict(),
            "zones": [zone.to_dict() for zone in self.zones],
        }


def independence(
    residual: Samples, reference: Samples, psd: Samples, heard: NDArray[np.bool_], silent: NDArray[np.bool_]
) -> Independence | None:
    """Test a residual (n,) against the aligned reference (n,); psd (601,): of the fan.

    heard, silent: (n,) bool, where the robot talks alone, and where nobody does. None for less than a second of the
    robot, and where nothing is left.

    Notes
    -----
    The residual goes through the causal filter that makes the calibrated fan white, the reference through its own
    linear prediction, and the cross-correlation is divided by what correlation the reference has left over the lags
    shown: pitch does not smear it. Of two independent series of which one is white, a correlation has the variance 1/N
    (Bartlett 1955; Box & Jenkins 1976, 11.1.3). Speech is not stationary, so the products of the squares stand in its
    place (White 1980). The residual's autocorrelation is held against that of the robot's silences, whose variance adds.
    """
    if np.count_nonzero(heard) < LEAST:
        return None
    white = convolve(residual, whitener(psd))[: residual.size].astype(np.float32)
    spoken = white * heard
    if not spoken.any():
        return None
    quiet = white * silent
    auto = _autocorrelation(spoken, quiet if np.count_nonzero(silent) >= LEAST and quiet.any() else None)
    cross, share = _cross_correlation(spoken, reference)
    zones = []
    for low, high, meaning in ZONES_MS:
        inside = (cross.lags_ms >= low) & (cross.lags_ms < high)
        part = Correlogram(*(array[inside] for array in vars(cross).values()))
        zones.append(Zone(float(low), float(high), meaning, float(np.clip(share[inside].sum(), 0.0, 1.0)), part))
    return Independence(auto, cross, tuple(zones), np.count_nonzero(heard) / SAMPLE_RATE)


def whitener(psd: Samples) -> Samples:
    """The causal filter of least phase that makes noise of that PSD (bins,) white with variance 1, (1200,)."""
    n = 4096
    bins = np.linspace(0, psd.size - 1, n // 2 + 1)
    level = np.interp(bins, np.arange(psd.size), np.log(floored(psd) * SAMPLE_RATE / 2))
    return scipy.fft.irfft(np.exp(log_response(-0.5 * level)))[:1200].astype(np.float32)


def lagged_sums(a: Samples, b: Samples, low: int, high: int) -> Array:
    """The sum over n of a[n] b[n - lag] for each lag from low on, of a and b (n,), (high - low,)."""
    width = high - low
    size = scipy.fft.next_fast_len(SPAN + width, real=True)
    count = -(-a.size // SPAN)
    before = max(high - 1, 0)
    padded = np.pad(b, (before, max(-low, 0) + count * SPAN - b.size + width))
    left = np.pad(a, (0, count * SPAN - a.size)).reshape(count, SPAN)
    right = sliding_window_view(padded, SPAN + width - 1)[before - high + 1 :: SPAN][:count]
    spectra = scipy.fft.rfft(right, size, axis=1) * np.conj(scipy.fft.rfft(left, size, axis=1))
    return scipy.fft.irfft(np.sum(spectra, axis=0, dtype=np.complex128), size)[:width][::-1]


def _autocorrelation(spoken: Samples, quiet: Samples | None) -> Correlogram:
    lags = -CROSS_MS[0] * PER_MS
    values, variance = _own(spoken, lags)
    expected, more = _own(quiet, lags) if quiet is not None else (np.zeros(lags), np.zeros(lags))
    return Correlogram(np.arange(1, lags + 1) / PER_MS, values, expected, BOUND * np.sqrt(variance + more))


def _own(x: Samples, lags: int) -> tuple[Array, Array]:
    """Autocorrelation of x at 1 to `lags` samples, and its variance were x independent from sample to sample."""
    square = x * x
    energy = float(np.sum(square, dtype=np.float64))
    return lagged_sums(x, x, 1, lags + 1) / energy, _positive(lagged_sums(square, square, 1, lags + 1)) / energy**2


def _cross_correlation(spoken: Samples, reference: Samples) -> tuple[Correlogram, Array]:
    """Cross-correlation with the whitened reference, and by lag the part of the residual's power that it explains."""
    low, high = (ms * PER_MS + PRE_ROLL for ms in CROSS_MS)
    said = _predicted_away(reference)
    energy = float(np.sum(said * said, dtype=np.float64))
    norm = np.sqrt(energy * float(np.sum(spoken * spoken, dtype=np.float64)))
    plain = lagged_sums(spoken, said, low, high) / norm
    variance = _positive(lagged_sums(spoken * spoken, said * said, low, high)) / norm**2
    own = lagged_sums(said, said, 0, high - low) / energy
    own[0] += RIDGE
    middle = np.eye(1, high - low, (high - low) // 2)[0]
    values, wider = scipy.linalg.solve_toeplitz(own, np.stack((plain, middle), axis=1)).T
    bounds = BOUND * np.sqrt(variance * wider[(high - low) // 2])
    lags_ms = (np.arange(low, high) - PRE_ROLL) / PER_MS
    return Correlogram(lags_ms, values, np.zeros(high - low), bounds), plain * values - variance


def _positive(sums: Array) -> Array:
    """Sums of squares, held above what rounding makes of those that are nearly zero."""
    return np.maximum(sums, 1e-3 * float(np.mean(np.abs(sums))))


def _predicted_away(reference: Samples) -> Samples:
    """The reference (n,) less what its last samples say of it: the input of its linear prediction, of mean square 1."""
    own = lagged_sums(reference, reference, 0, ORDER + 1)
    own[0] = own[0] * (1.0 + 1e-6) + 1e-20
    taps = scipy.linalg.solve_toeplitz(own[:-1], own[1:])
    said = scipy.signal.lfilter(np.concatenate(([1.0], -taps)), 1.0, reference)
    return (said / max(float(np.sqrt(np.mean(said**2))), 1e-12)).astype(np.float32)
