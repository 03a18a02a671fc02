"""Search of the whole range of lags for one utterance, by whitened cross-correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d

from edgefilter.delay_line import Tape
from edgefilter.types import Samples

WINDOW = 7168
"""Samples of the microphone that one search looks at, 0.45 s."""
MINIMUM = 1280
"""Samples (80 ms) of an utterance that must have been heard before its lag is believed: less of any two sounds may agree by chance."""
FADE = 256
_RISE = (0.5 - 0.5 * np.cos(np.pi * (np.arange(FADE) + 0.5) / FADE)).astype(np.float32)
SMOOTHING = 65
"""Bins over which spectra are averaged for the whitening, about 30 Hz: voice harmonics are flattened, so pitch makes no side peak."""
APART = 320
"""Two peaks closer than this (20 ms) are one arrival and its reflections."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Lag in samples of the highest peak; its height over the rms of the other lags, and over the highest peak elsewhere."""

    lag: int
    strength: float
    ratio: float


class LagSearch:
    """Generalised cross-correlation (Knapp & Carter 1976) of the last WINDOW samples of mic with the reference before them.

    Both spectra are divided by the square root of their smoothed power. response (taps,), if known, is the echo path around
    its direct sound at index pre_roll: its phase is taken out, so that early reflections do not pull the peak. Chance peaks
    grow with the root of the energy that a lag lets overlap, so the correlation is divided by that.
    """

    def __init__(self, max_lag: int, response: Samples | None = None, pre_roll: int = 0) -> None:
        self.max_lag = max_lag
        self._size = fft.next_fast_len(max_lag + WINDOW, real=True)
        self.span = self._size
        self._signed = response is not None
        self._phase = None
        if response is not None:
            spectrum = np.conj(fft.rfft(np.roll(np.pad(response, (0, self._size - response.size)), -pre_roll)))
            self._phase = (spectrum / np.maximum(np.abs(spectrum), 1e-12)).astype(np.complex64)

    def find(self, mic: Tape, ref: Tape, now: int, since: int, mic_since: int) -> Candidate | None:
        """The best lag between the reference after position `since` and the microphone after `mic_since`.

        None where there is nothing to compare, or where less than MINIMUM of them would overlap at the best lag.
        """
        size, skipped = self._size, max(max(mic_since, since) - (now - WINDOW), 0)
        if skipped >= WINDOW - MINIMUM:
            return None
        x, r = np.zeros(size, np.float32), np.zeros(size, np.float32)
        x[size - WINDOW + skipped :] = mic.read(now - WINDOW + skipped, now)
        first = max(since - (now - size), 0)
        r[first:] = ref.read(now - size + first, now)
        _soften(x[size - WINDOW + skipped :])
        _soften(r[first:])
        overlap = self._overlap(r, size - WINDOW + skipped)
        if overlap.max() <= 0.0 or not x.any():
            return None
        correlation = fft.irfft(self._whiten(fft.rfft(x), fft.rfft(r)), size)[: self.max_lag]
        score = correlation / np.sqrt(overlap + 0.1 * overlap.max())
        found = self._judge(score if self._signed else np.abs(score), overlap)
        return None if found is None or now - since - found.lag < MINIMUM else found

    def _overlap(self, r: Samples, mic_start: int) -> Samples:
        """(max_lag,) energy of the reference, first difference, that falls under the microphone's window at each lag."""
        step = np.diff(r, prepend=r[:1])
        total = np.concatenate(([0.0], np.cumsum(np.square(step, dtype=np.float64))))
        upper = total[self._size - self.max_lag + 1 : self._size + 1][::-1]
        lower = np.zeros(self.max_lag)
        count = min(self.max_lag, mic_start + 1)
        lower[:count] = total[mic_start - count + 1 : mic_start + 1][::-1]
        return (upper - lower).astype(np.float32)

    def _whiten(self, x: np.ndarray, r: np.ndarray) -> np.ndarray:
        power = _power(x)
        power_r = _power(r)
        cross = x * np.conj(r)
        if self._phase is not None:
            cross *= self._phase
        low = int(100 * self._size / 16000)
        cross[:low] = 0.0
        return cross / np.sqrt((power + 1e-6 * power.max() + 1e-20) * (power_r + 1e-5 * power_r.max() + 1e-20))

    def _judge(self, score: Samples, overlap: Samples) -> Candidate | None:
        usable = overlap > 0.05 * overlap.max()
        spread = float(np.sqrt(np.mean(np.square(score[usable]))))
        if spread <= 0.0:
            return None
        lag = int(np.argmax(score))
        rest = np.concatenate((score[: max(lag - APART, 0)], score[lag + APART :]))
        second = float(rest.max()) if rest.size else 0.0
        return Candidate(lag, float(score[lag]) / spread, float(score[lag]) / max(second, 1e-12))


def _soften(x: Samples) -> None:
    """Fade both ends of x in place: two hard cuts, whitened, would correlate with one another."""
    x[:FADE] *= _RISE
    x[-FADE:] *= _RISE[::-1]


def _power(spectrum: np.ndarray) -> Samples:
    return uniform_filter1d(spectrum.real**2 + spectrum.imag**2, SMOOTHING, mode="nearest")
