"""By how much a whole recording lags behind what a profile predicts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import uniform_filter1d

from edgefilter.dsp.fractional_delay import delayed
from edgefilter.errors import SignalError
from edgefilter.types import SAMPLE_RATE, Samples

MAX_OFFSET = 3.0
"""Seconds by which the recording may lag behind or lead the calibration's."""
TRACK = SAMPLE_RATE
"""Samples of one window of the lag track."""
TRACK_REACH = 1600
"""Samples by which the lag may move away from that of the whole recording and still be followed."""


def starting_offset(predicted: Samples, recording: Samples) -> float:
    """Samples by which recording (n,) lags behind predicted (n,) at its beginning, both whitened.

    Over the whole of it where the lag is constant; where it moves (drift, jumps, a changed path), over the first seconds in which it
    holds still, so that what happens later is left in the residual. Raises SignalError where no lag stands out.
    """
    whole = find_offset(predicted, recording)
    windows = lag_track(predicted, recording, whole)
    clear = [window for window in windows if window.likeness > 0.5 * max(w.likeness for w in windows)]
    if len(clear) < 4:
        return whole
    lags = np.array([window.lag for window in clear])
    first = float(np.median(lags[:3]))
    middle = float(np.median(lags))
    if np.quantile(np.abs(lags - middle), 0.8) < 0.06 and abs(first - middle) < 0.06:
        return whole
    stop = next((window.stop for window, lag in zip(clear, lags, strict=True) if abs(lag - first) > 0.3), clear[-1].stop)
    stop = max(min(stop - TRACK // 2, clear[0].start + 4 * TRACK), clear[0].start + TRACK)
    part = slice(max(clear[0].start - TRACK // 2, 0), stop)
    moved = delayed(predicted, first)
    return first + refine_lag(moved[part], recording[part], 0.0)


@dataclass(frozen=True, slots=True)
class LagWindow:
    """One window of a lag track: samples start to stop, lag in samples, likeness (correlation coefficient) at that lag."""

    start: int
    stop: int
    lag: float
    likeness: float


def lag_track(predicted: Samples, recording: Samples, around: float) -> list[LagWindow]:
    """The lag of recording behind predicted (n,), both whitened, in windows of TRACK samples, up to TRACK_REACH samples from `around`.

    Windows in which the prediction does not stand out of the fan are left out.
    """
    moved = delayed(predicted, around)
    size = fft.next_fast_len(TRACK + 2 * TRACK_REACH, real=True)
    found = []
    for start in range(0, recording.size - TRACK + 1, TRACK // 2):
        wide = moved[max(start - TRACK_REACH, 0) : start + TRACK + TRACK_REACH]
        skipped = start - max(start - TRACK_REACH, 0)
        a, b = wide, recording[start : start + TRACK]
        energy = float(np.dot(moved[start : start + TRACK], moved[start : start + TRACK]))
        if energy < TRACK:
            continue
        correlation = fft.irfft(flat_cross(a, np.pad(b, (skipped, 0)), size), size)
        near = np.take(correlation, np.arange(-TRACK_REACH, TRACK_REACH + 1), mode="wrap")
        lag = int(np.argmax(near)) - TRACK_REACH
        there = moved[max(start - lag, 0) : start - lag + TRACK]
        likeness = float(np.dot(there, b[: there.size])) / np.sqrt(float(np.dot(there, there)) * float(np.dot(b, b)) + 1e-12)
        if likeness > 0.0:
            fine = refine_lag(a, np.pad(b, (skipped, a.size - skipped - b.size)), float(lag))
            found.append(LagWindow(start, start + TRACK, around + fine, likeness))
    return found


def find_offset(predicted: Samples, recording: Samples) -> float:
    """Samples, to a few thousandths, by which recording (n,) lags behind predicted (n,): the highest peak of their correlation.

    Raises SignalError where no lag stands out.
    """
    n = fft.next_fast_len(2 * recording.size, real=True)
    cross = flat_cross(predicted, recording, n)
    correlation = fft.irfft(cross, n)
    reach = min(int(MAX_OFFSET * SAMPLE_RATE), recording.size - 1)
    near = np.concatenate((correlation[-reach:], correlation[: reach + 1]))
    peak = int(np.argmax(near))
    if near[peak] < 12.0 * np.sqrt(np.mean(near**2)):
        raise SignalError("the recording does not contain the reference at any lag up to 3 s: are both of the same utterance?")
    return _climb(cross, n, float(peak - reach))


def flat_cross(predicted: Samples, recording: Samples, n: int) -> NDArray[np.complex128]:
    """(n // 2 + 1,) cross-spectrum Y P* / (|P|^2 + N) of two whitened signals: flat where the voice stands out of the fan, nothing else.

    The maximum-likelihood weighting of Knapp & Carter (1976) for an error in proportion to the voice; |P|^2 is smoothed over 50 Hz.
    """
    source = fft.rfft(predicted.astype(np.float64), n)
    power = uniform_filter1d(np.abs(source) ** 2, max(int(50 * n / SAMPLE_RATE), 1), mode="nearest")
    return fft.rfft(recording.astype(np.float64), n) * source.conj() / (power + recording.size)


def refine_lag(predicted: Samples, recording: Samples, lag: float) -> float:
    """The fractional lag near `lag` at which predicted (n,) correlates best with recording (n,)."""
    n = fft.next_fast_len(2 * recording.size, real=True)
    return _climb(flat_cross(predicted, recording, n), n, lag)


def _climb(cross: NDArray[np.complex128], n: int, lag: float) -> float:
    """From `lag` to the top of the correlation whose cross-spectrum this is, of n samples: Newton steps."""
    frequencies = 2 * np.pi * np.arange(cross.size) / n
    for _ in range(8):
        turned = cross * np.exp(1j * frequencies * lag)
        slope, bend = -np.sum(frequencies * turned.imag), -np.sum(frequencies**2 * turned.real)
        if bend >= 0.0:
            break
        step = float(np.clip(-slope / bend, -0.5, 0.5))
        lag += step
        if abs(step) < 1e-4:
            break
    return lag
