"""Search of the whole range of lags for one utterance, by whitened cross-correlation, a share of the work in each hop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from edgefilter.alignment.announced import Playback
from edgefilter.alignment.delay_line import Tape
from edgefilter.dsp.lag import LOWEST_HZ, flattened
from edgefilter.types import SAMPLE_RATE, Samples

WINDOW = 7168
"""Samples of the microphone that one search looks at, 0.45 s."""
MINIMUM = 832
"""Samples (52 ms) of an utterance that must have been heard before its lag is believed: less of any two sounds may
agree by chance."""
FADE = 256
_RISE = (0.5 - 0.5 * np.cos(np.pi * (np.arange(FADE) + 0.5) / FADE)).astype(np.float32)
REFLECTIONS, REFLECTED = 320, 0.75
"""Peaks up to 20 ms behind an arrival may be its reflections and count only this much against it."""
COARSE = 32
"""Samples over which the energies that lags let overlap are summed."""
NEAR, ASIDE = 12, 512
"""Lags on each side of a peak that are the same peak, and those that an earlier window is compared at."""

BETWEEN = 1024
"""Samples between the two windows, so that one short agreement does not reach into both."""
CERTAIN, CERTAIN_EARLY, EARLY = 30.0, 20.0, 2432
"""A search's strength times ratio that decides, and what does when two searches in a row find it at one lag of which at
most EARLY samples were heard, so that a third of them were new. Beside a human as loud as the robot the true lag has a
median of 40 after 60 ms, and 150 after 150 ms; chance, in an hour of other speech while the reference played unheard,
26, and 22 early."""
SEEN = 5.0
"""Strength that a lag at which more than a window of the utterance must have been heard already has to show in the
window before as well; then CERTAIN_EARLY is enough. True lags have 10 there, chance 3.3."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Lag in samples of the highest peak, its height over the rms of all lags and over the highest peak elsewhere.

    Two voices of like pitch agree at many lags, a period apart, the robot with itself at one.
    at: sample counter of the microphone at the end of the window. heard: samples of the utterance that it holds if the
    lag is true.
    """

    lag: int
    strength: float
    ratio: float
    at: int
    heard: int


class LagSearch:
    """Generalised cross-correlation (Knapp & Carter 1976) of the last WINDOW samples of mic with the reference before them.

    Both spectra are divided by the square root of their smoothed power. response (taps,), if known, is the echo path
    around its direct sound at index pre_roll: its phase is taken out, so that early reflections do not pull the peak.
    Chance peaks grow with the root of the energy that a lag lets overlap, so the correlation is divided by that.
    `prepare`, `listen` and `find` are one search and cost one transform each, so that they can be spread over three
    hops; while the reference to be looked at is short, so are the transforms.
    """

    def __init__(self, max_lag: int, response: Samples | None = None, pre_roll: int = 0) -> None:
        self.max_lag = max_lag
        self.span = self._size = COARSE * fft.next_fast_len(-(-(max_lag + WINDOW) // COARSE), real=True)
        self._signed = response is not None
        self._short = COARSE * fft.next_fast_len(-(-self.span // (2 * COARSE)), real=True)
        self._phases = {size: _phase(response, pre_roll, size) for size in (self.span, self._short, WINDOW + 2 * ASIDE)}

    def prepare(self, ref: Tape | Playback, now: int, since: int) -> None:
        """Take the reference between the positions since and now."""
        self._size = size = self._short if now - since <= self._short - WINDOW else self.span
        self._reach = min(self.max_lag, size - WINDOW)
        first = max(since - (now - size), 0)
        r = np.zeros(size, np.float32)
        r[first:] = ref.read(now - size + first, now)
        _soften(r[first:])
        step = np.diff(r, prepend=r[:1])
        self._total = np.concatenate(
            ([0.0], np.cumsum(np.square(step, out=step).reshape(-1, COARSE).sum(axis=1), dtype=np.float64))
        )
        self._reference = flattened(fft.rfft(r), 1e-5)
        self._prepared, self._since = now, since

    def listen(self, mic: Tape, now: int, since: int) -> None:
        """Take the microphone up to now, but none of it before since; at most WINDOW samples after `prepare`."""
        skipped = min(max(max(since, self._since) - (now - WINDOW), 0), WINDOW)
        self._at, self._start = now, self._size - WINDOW + skipped
        if skipped > WINDOW - MINIMUM:
            self._cross = None
            return
        x = np.zeros(self._size, np.float32)
        x[self._start :] = mic.read(now - WINDOW + skipped, now)
        _soften(x[self._start :])
        self._cross = flattened(fft.rfft(x), 1e-6) * np.conj(self._reference) if x.any() else None
        if self._cross is not None:
            self._cross[: int(LOWEST_HZ * self._size / SAMPLE_RATE)] = 0.0
            self._cross *= self._phases[self._size]

    def find(self) -> Candidate | None:
        """The best lag between what was prepared and what was listened to.

        None where there is nothing to compare, or where less than MINIMUM of them would overlap at the best lag.
        """
        if self._cross is None:
            return None
        late = self._at - self._prepared
        overlap = self._overlap(late)
        if overlap.max() <= 0.0:
            return None
        correlation = fft.irfft(self._cross, self._size)
        score = np.concatenate((correlation[self._size - late :], correlation[: self._reach - late]))
        if not self._signed:
            np.abs(score, out=score)
        score *= np.repeat(1.0 / np.sqrt(overlap + 0.1 * overlap.max()), COARSE)[: self._reach]
        usable = np.repeat(overlap > 0.05 * overlap.max(), COARSE)[: self._reach]
        spread = float(np.sqrt(np.dot(score, score * usable) / np.count_nonzero(usable)))
        lag = int(np.argmax(score))
        heard = self._at - self._since - lag
        if spread <= 0.0 or heard < MINIMUM:
            return None
        reflected = REFLECTED * score[lag + NEAR : lag + REFLECTIONS].max(initial=0.0)
        second = max(
            score[: max(lag - NEAR, 0)].max(initial=0.0), reflected, score[lag + REFLECTIONS :].max(initial=0.0)
        )
        return Candidate(
            lag, float(score[lag]) / spread, float(score[lag]) / max(float(second), 1e-12), self._at, heard
        )

    def before(self, mic: Tape, ref: Tape | Playback, found: Candidate) -> float:
        """Strength of the found lag in an earlier window of the microphone, BETWEEN samples before the one that it was found in."""
        stop = found.at - WINDOW - BETWEEN
        x = np.zeros(WINDOW + 2 * ASIDE, np.float32)
        x[ASIDE:-ASIDE] = mic.read(stop - WINDOW, stop)
        _soften(x[ASIDE:-ASIDE])
        r = ref.read(stop - WINDOW - found.lag - ASIDE, stop - found.lag + ASIDE).copy()
        _soften(r)
        cross = flattened(fft.rfft(x), 1e-6) * np.conj(flattened(fft.rfft(r), 1e-5)) * self._phases[x.size]
        cross[: int(LOWEST_HZ * x.size / SAMPLE_RATE)] = 0.0
        score = np.roll(fft.irfft(cross, x.size), ASIDE)[: 2 * ASIDE]
        if not self._signed:
            np.abs(score, out=score)
        return float(score[ASIDE - NEAR : ASIDE + NEAR].max()) / (float(np.sqrt(np.mean(np.square(score)))) + 1e-20)

    def _overlap(self, late: int) -> Samples:
        """Energy of the reference, first difference, that falls under the microphone's window, at every COARSE-th lag."""
        last = self._total.size - 1
        lags = np.arange(0, self._reach, COARSE)
        upper = np.clip((self._size + late - lags) // COARSE, 0, last)
        lower = np.clip((self._start + late - lags) // COARSE, 0, last)
        return (self._total[upper] - self._total[lower]).astype(np.float32)


def _soften(x: Samples) -> None:
    """Fade both ends of x, of any length, in place: two hard cuts, whitened, would correlate with one another."""
    rise = _RISE[: x.size]
    x[: rise.size] *= rise
    x[x.size - rise.size :] *= rise[::-1]


def _phase(response: Samples | None, pre_roll: int, size: int) -> np.ndarray | np.complex64:
    """What takes the response's phase out of a cross-spectrum."""
    if response is None:
        return np.complex64(1.0)
    spectrum = np.conj(fft.rfft(np.roll(np.pad(response, (0, size - response.size)), -pre_roll)))
    return (spectrum / np.maximum(np.abs(spectrum), 1e-12)).astype(np.complex64)
