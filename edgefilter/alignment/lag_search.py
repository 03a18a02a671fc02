"""Search of the whole range of lags for one utterance, by whitened cross-correlation, a share of the work in each hop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from edgefilter.alignment.delay_line import WAIT, DelayBuffer
from edgefilter.alignment.utterances import Playback
from edgefilter.dsp.frames import rise
from edgefilter.dsp.lag import LOWEST_HZ, flattened
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Samples

MOST_LAG_S = 3.0
"""Lag of the playback up to which it is found: of speech that comes in a burst and is played later, over a network."""
WINDOW = 7168
"""Samples of the microphone that one search looks at, 0.45 s."""
MINIMUM = 832
"""Samples (52 ms) of an utterance that must have been heard before its lag is believed: less of any two sounds may agree by chance."""
FADE = 256
_RISE = rise(FADE).astype(np.float32)
REFLECTIONS, REFLECTED = 320, 0.75
"""Peaks up to 20 ms behind an arrival may be its reflections and count only this much against it."""
SAME = 32
"""Lags that are one where only the place matters: they share one normalisation, by the energy that is summed up in steps of so many samples,
and the lags of two looks may differ by it, which is what clocks and a person who walks move it by."""
NEAR, ASIDE = 12, 512
"""Lags on each side of a peak that belong to it, and lags on each side of the one found over which `before` correlates the
earlier window."""
BETWEEN = 1024
"""Samples between the two windows, so that one short agreement does not reach into both."""
EVEN, STEEP, EARLY_ODDS = 1.37, 9.9, 0.05
"""Clearness of a lag that is as likely right as not, the power of it that the odds grow with, and what is left of the odds where the
reference would come more than WAIT after its echo. Fitted to 12 minutes of robots in measured rooms, beside noise and humans
up to 5 dB louder, and as many of other speech while the robot is not heard."""
CERTAIN = 100.0
"""Odds from which on a lag is believed, and the odds against it from which on it is given up: while a human and an unheard robot
talk all the time, a wrong one in an hour."""
ALIKE = 0.05
"""Probability that all looks share one error: a reflection taken for the direct sound, a path without a sharp peak, a path that was
calibrated elsewhere. However many there are, looks raise the odds by 1/ALIKE at most: where that may be so one earlier look
is taken, and only for a lag with odds of CERTAIN * ALIKE or more. That a lag was followed before raises them by as much."""
MISSED = 0.3
"""Probability that a second with audible robot has no peak at its lag: .21 of the seconds in 19 real recordings had none."""


@dataclass(frozen=True, slots=True)
class Found:
    """The likeliest lag in samples, and its clearness: its evidence over that of the likeliest lag away from it.

    Another voice of similar pitch matches the reference at many lags, a period apart; the robot's own voice at one alone. at: sample
    counter of the microphone at the end of the search. heard: samples of the utterance that were heard if the lag is right.
    """

    lag: int
    clearness: float
    at: int = 0
    heard: int = 0

    @classmethod
    def followed(cls, lag: int, probability: float, at: int) -> Found:
        """A lag that is known with that probability without a look."""
        odds = probability / (1.0 - probability) / cls(lag, 1.0).prior
        return cls(lag, EVEN * odds ** (1.0 / STEEP), at)

    @property
    def old(self) -> bool:
        """Whether the utterance would have sounded for so long that the window before must show it too."""
        return self.heard > WINDOW + BETWEEN + MINIMUM

    @property
    def prior(self) -> float:
        """Probability of this lag before anything is heard, divided by that of a lag that robots usually have."""
        return EARLY_ODDS if self.lag < -WAIT else 1.0

    @property
    def odds(self) -> float:
        """Odds that the robot is heard at this lag; before the search it is as likely not to be heard at all."""
        return (self.clearness / EVEN) ** STEEP * self.prior


class LagSearch:
    """Generalised cross-correlation (Knapp & Carter 1976) of the last WINDOW samples of mic with the reference before them.

    Both spectra are divided by the square root of their smoothed power. responses, if known, are the echo paths (taps,) of
    the microphones on one clock, around the direct sound in the first at index PRE_ROLL: their phases are taken out, so
    that early reflections do not pull the peak, and the peaks of all microphones lie at one lag. Chance peaks grow with the
    root of the energy that a lag lets overlap, so the correlation is divided by that. `prepare`, `listen` and `find` are one
    search and cost one transform each, `listen` one a microphone, so that they can be spread over three hops. max_lag, early:
    samples by which the microphone and the reference may be late. any_lag: by which they may be in a look that supposes
    nothing, and of the microphone in that look, WINDOW or more.
    """

    def __init__(
        self,
        max_lag: int,
        responses: Sequence[Samples] = (),
        early: int = 0,
        any_lag: tuple[int, ...] = (0, 0, WINDOW),
    ) -> None:
        self._for_utterance, self._for_any = (max_lag, early, WINDOW), any_lag
        self.span, self._whole = _fast(sum(any_lag)), _fast(sum(self._for_utterance))
        self._short, self._signed = _fast(self._whole // 2), False
        sizes = (self._whole, self._short, WINDOW + 2 * ASIDE)
        self._phases = {size: [_phase(one[: PRE_ROLL + REFLECTIONS], size) for one in responses] for size in sizes}

    def prepare(self, ref: DelayBuffer | Playback, now: int, since: int | None = None) -> None:
        """Read the reference from sample counter `since`, or all of it and suppose nothing, up to `now`; transform it for `listen`."""
        if since is None:
            since, size, (most, self._early, self._window) = now - self.span, self.span, self._for_any
        else:
            most, self._early, self._window = self._for_utterance
            size = self._short if now - since <= self._short - self._early - WINDOW else self._whole
        self._size, self._signed = size, bool(self._phases.get(size))
        self._lags = self._early + min(most, size - self._early - self._window)
        first = max(since - (now - size), self._early)
        r = np.zeros(size, np.float32)
        r[first:] = ref.read(now - size + first, now)
        _soften(r[first:])
        step = np.diff(r, prepend=r[:1])
        self._total = np.concatenate(
            ([0.0], np.cumsum(np.square(step, out=step).reshape(-1, SAME).sum(axis=1), dtype=np.float64))
        )
        self._reference = flattened(fft.rfft(r), 1e-5)
        self._prepared, self._since = now, since

    def listen(self, mics: Mapping[int, DelayBuffer], now: int, since: int) -> None:
        """Take the microphones by their number, several where the responses are known, from since up to now; at most a window after `prepare`."""
        skipped = min(max(max(since, self._since) - (now - self._window), 0), self._window)
        self._at, self._start = now, self._size - self._window + skipped
        self._crosses = []
        for number, mic in mics.items() if skipped <= self._window - MINIMUM else ():
            x = np.zeros(self._size, np.float32)
            x[self._start :] = mic.read(now - self._window + skipped, now)
            _soften(x[self._start :])
            if x.any():
                self._crosses.append(self._whitened(x, self._reference, number))

    def find(self) -> Found | None:
        """The likeliest lag; None where there is nothing to compare, or less than MINIMUM of it would overlap.

        The microphones' correlations are summed: where their noises are independent, the log likelihood of a lag grows with each. Of three
        or more the highest at a lag is lowered to the second highest, since a peak in one channel alone may be a loopback's.
        """
        if not self._crosses:
            return None
        # energy of the reference's first difference within the microphone's window, at every SAME-th lag: it hardly changes between
        late = self._at - self._prepared
        lags, last = np.arange(0, self._lags, SAME) - self._early, self._total.size - 1
        upper, lower = (np.clip((end + late - lags) // SAME, 0, last) for end in (self._size, self._start))
        overlap = (self._total[upper] - self._total[lower]).astype(np.float32)
        weight = np.repeat(1.0 / np.sqrt(overlap + 0.1 * overlap.max() + 1e-30), SAME)[: self._lags]
        scores = np.sort([self._scored(cross, late + self._early, weight) for cross in self._crosses], axis=0)
        if len(scores) > 2:
            scores[-1] = scores[-2]
        score = scores.sum(axis=0)
        at = int(np.argmax(score))
        lag = at - self._early
        heard = self._at - self._since - max(lag, 0)
        return Found(lag, _clearness(score, at), self._at, heard) if heard >= MINIMUM and score[at] > 0.0 else None

    def _scored(self, cross: np.ndarray, before: int, weight: Samples) -> Samples:
        """The correlation at lags from -before on, times a weight (lags,) that allows for their overlap, divided by its root mean square."""
        correlation = fft.irfft(cross, self._size)
        score = np.concatenate((correlation[self._size - before :], correlation[: self._lags - before]))
        if not self._signed:
            np.abs(score, out=score)
        score *= weight
        score /= np.sqrt(np.dot(score, score) + 1e-30)
        return score

    def before(self, number: int, mic: DelayBuffer, ref: DelayBuffer | Playback, found: Found) -> Found:
        """The same lag with the odds after one more window of this microphone, which ends BETWEEN samples before the one that `found` is of.

        One window raises the odds by a factor of CERTAIN at most: a short sound of another source may match the reference by chance.
        """
        stop = found.at - WINDOW - BETWEEN
        x = np.zeros(WINDOW + 2 * ASIDE, np.float32)
        x[ASIDE:-ASIDE] = mic.read(stop - WINDOW, stop)
        _soften(x[ASIDE:-ASIDE])
        r = ref.read(stop - WINDOW - found.lag - ASIDE, stop - found.lag + ASIDE).copy()
        _soften(r)
        cross = self._whitened(x, flattened(fft.rfft(r), 1e-5), number)
        score = np.roll(fft.irfft(cross, x.size), ASIDE)[: 2 * ASIDE]
        if not self._signed:
            np.abs(score, out=score)
        at = ASIDE - NEAR + int(np.argmax(score[ASIDE - NEAR : ASIDE + NEAR]))
        shown = min(MISSED + _clearness(score, at) ** STEEP, CERTAIN)
        clearness = found.clearness * (min(CERTAIN / found.odds, 1.0) * shown) ** (1.0 / STEEP)
        return Found(found.lag, clearness, stop, found.heard - WINDOW - BETWEEN)

    def _whitened(self, heard: Samples, reference: np.ndarray, number: int) -> np.ndarray:
        """Whitened cross-spectrum of a microphone's sound (n,) and the reference, 0 below LOWEST_HZ, without the phase of the known path."""
        cross = flattened(fft.rfft(heard), 1e-6) * np.conj(reference)
        cross[: int(LOWEST_HZ * heard.size / SAMPLE_RATE)] = 0.0
        if self._signed:
            cross *= self._phases[heard.size][number]
        return cross


def _clearness(score: Samples, at: int) -> float:
    """The peak of score (lags,) at this index over the highest elsewhere; 0 for none."""
    earlier, later = score[: max(at - NEAR, 0)].max(initial=0.0), score[at + REFLECTIONS :].max(initial=0.0)
    second = max(earlier, REFLECTED * score[at + NEAR : at + REFLECTIONS].max(initial=0.0), later)
    return max(float(score[at]), 0.0) / max(float(second), 1e-12)


def _fast(size: int) -> int:
    """The next larger size, a multiple of SAME, whose transform is fast."""
    return SAME * fft.next_fast_len(-(-size // SAME), real=True)


def _soften(x: Samples) -> None:
    """Fade both ends of x, of any length, in place: two hard cuts, whitened, would correlate with one another."""
    rise = _RISE[: x.size]
    x[: rise.size] *= rise
    x[x.size - rise.size :] *= rise[::-1]


def _phase(response: Samples, size: int) -> np.ndarray:
    """What takes the response's phase out of a cross-spectrum."""
    spectrum = np.conj(fft.rfft(np.roll(np.pad(response, (0, size - response.size)), -PRE_ROLL)))
    return (spectrum / np.maximum(np.abs(spectrum), 1e-12)).astype(np.complex64)
