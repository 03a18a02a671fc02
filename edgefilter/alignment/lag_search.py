"""Search of the whole range of lags for one utterance, by whitened cross-correlation, a share of the work in each hop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from edgefilter.alignment.delay_line import Tape
from edgefilter.alignment.utterances import Playback
from edgefilter.dsp.frames import rise
from edgefilter.dsp.lag import LOWEST_HZ, flattened
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Samples

WINDOW = 7168
"""Samples of the microphone that one search looks at, 0.45 s."""
MINIMUM = 832
"""Samples (52 ms) of an utterance that must have been heard before its lag is believed: less of any two sounds may
agree by chance."""
FADE = 256
_RISE = rise(FADE).astype(np.float32)
REFLECTIONS, REFLECTED = 320, 0.75
"""Peaks up to 20 ms behind an arrival may be its reflections and count only this much against it."""
COARSE = 32
"""Samples over which the energies that lags let overlap are summed."""
NEAR, ASIDE = 12, 512
"""Lags on each side of a peak that are the same peak, and those that an earlier window is compared at."""
BETWEEN = 1024
"""Samples between the two windows, so that one short agreement does not reach into both."""
CERTAIN, CERTAIN_EARLY, EARLY = 30.0, 20.0, 2432
"""Evidence that decides, and what does when two searches in a row find one lag at which at most EARLY samples were heard, so
that a third of them were new. Beside a human as loud as the robot the true lag has a median of 40 after 60 ms, and 150
after 150 ms; chance, in an hour of other speech while the reference played unheard, 26, and 22 early."""
SEEN = 5.0
"""Strength in the window before with which CERTAIN_EARLY is enough. True lags have 10 there, chance 3.3."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Lag in samples of the highest peak, its height over the rms of all lags and over the highest peak elsewhere.

    Two voices of like pitch agree at many lags, a period apart, the robot with itself at one. at: sample counter of the
    microphone at the end of the window. heard: samples of the utterance that it holds if the lag is true.
    """

    lag: int
    strength: float
    ratio: float
    at: int
    heard: int

    @property
    def evidence(self) -> float:
        """Strength times ratio: how far the peak stands out of chance."""
        return self.strength * self.ratio

    @property
    def old(self) -> bool:
        """Whether it is likely, and an utterance that has sounded for so long that the window before must show it too."""
        return self.heard > WINDOW + BETWEEN + MINIMUM and self.evidence > CERTAIN_EARLY

    def certain(self, again: bool) -> bool:
        """Whether it is beyond chance. again: the search before has found it as well.

        A reference after its echo is rare: it is believed only once the window before shows it too (see `old`).
        """
        enough = CERTAIN_EARLY if again and self.heard <= EARLY else CERTAIN
        return self.evidence > enough and self.heard <= WINDOW and self.lag >= 0


class LagSearch:
    """Generalised cross-correlation (Knapp & Carter 1976) of the last WINDOW samples of mic with the reference before them.

    Both spectra are divided by the square root of their smoothed power. responses, if known, are the echo paths (taps,) of
    the microphones on one clock, around the direct sound in the first at index PRE_ROLL: their phases are taken out, so
    that early reflections do not pull the peak, and the peaks of all microphones lie at one lag, where they are summed.
    Chance peaks grow with the root of the energy that a lag lets overlap, so the correlation is divided by that.
    `prepare`, `listen` and `find` are one search and cost one transform each, `listen` one a microphone, so that they
    can be spread over three hops; while the reference to be looked at is short, so are the transforms.
    """

    def __init__(self, max_lag: int, responses: Sequence[Samples] | None = None, early: int = 0) -> None:
        self._max_lag, self._early = max_lag, early
        self.span = self._size = COARSE * fft.next_fast_len(-(-(max_lag + early + WINDOW) // COARSE), real=True)
        self._signed = responses is not None
        self._short = COARSE * fft.next_fast_len(-(-self.span // (2 * COARSE)), real=True)
        sizes = (self.span, self._short, WINDOW + 2 * ASIDE)
        self._phases = {size: [_phase(one, size) for one in responses or ()] for size in sizes}

    def prepare(self, ref: Tape | Playback, now: int, since: int) -> None:
        """Take the reference between the positions since and now."""
        self._size = size = self._short if now - since <= self._short - self._early - WINDOW else self.span
        self._lags = self._early + min(self._max_lag, size - self._early - WINDOW)
        first = max(since - (now - size), self._early)
        r = np.zeros(size, np.float32)
        r[first:] = ref.read(now - size + first, now)
        _soften(r[first:])
        step = np.diff(r, prepend=r[:1])
        self._total = np.concatenate(
            ([0.0], np.cumsum(np.square(step, out=step).reshape(-1, COARSE).sum(axis=1), dtype=np.float64))
        )
        self._reference = flattened(fft.rfft(r), 1e-5)
        self._prepared, self._since = now, since

    def listen(self, mics: Mapping[int, Tape], now: int, since: int) -> None:
        """Take the microphones up to now, but none of it before since; at most WINDOW samples after `prepare`.

        mics: by number, where the responses are known several; their evidence is summed.
        """
        skipped = min(max(max(since, self._since) - (now - WINDOW), 0), WINDOW)
        self._at, self._start = now, self._size - WINDOW + skipped
        self._crosses = []
        for number, mic in mics.items() if skipped <= WINDOW - MINIMUM else ():
            x = np.zeros(self._size, np.float32)
            x[self._start :] = mic.read(now - WINDOW + skipped, now)
            _soften(x[self._start :])
            if x.any():
                self._crosses.append(self._whitened(x, self._reference, number))

    def find(self) -> Candidate | None:
        """The best lag; None where there is nothing to compare, or less than MINIMUM of it would overlap.

        Of several microphones that of the first, or of all together where that is more evident; but not where it is seen
        in one alone, which may be broken, or a loopback.
        """
        if not self._crosses:
            return None
        first = self._best(*self._scored(self._crosses[0]))
        if len(self._crosses) == 1:
            return first
        together = self._best(*self._scored(np.add.reduce(self._crosses)))
        if together is None or together.evidence <= max(first.evidence if first else 0.0, CERTAIN_EARLY):
            return first
        at = together.lag + self._early
        near = slice(max(at - NEAR, 0), at + NEAR)
        alone = [self._scored(cross) for cross in self._crosses]
        return together if sum(score[near].max() > SEEN * spread for score, spread in alone) > 1 else first

    def _scored(self, cross: np.ndarray) -> tuple[Samples, float]:
        """The correlation (lags,) over what a lag lets overlap, and its rms, 0 where nothing overlaps."""
        late = self._at - self._prepared
        overlap = self._overlap(late)
        if overlap.max() <= 0.0:
            return np.zeros(self._lags, np.float32), 0.0
        correlation, before = fft.irfft(cross, self._size), late + self._early
        score = np.concatenate((correlation[self._size - before :], correlation[: self._lags - before]))
        if not self._signed:
            np.abs(score, out=score)
        score *= np.repeat(1.0 / np.sqrt(overlap + 0.1 * overlap.max()), COARSE)[: self._lags]
        usable = np.repeat(overlap > 0.05 * overlap.max(), COARSE)[: self._lags]
        causal, usable = score[self._early :], usable[self._early :]
        return score, float(np.sqrt(np.dot(causal, causal * usable) / max(np.count_nonzero(usable), 1)))

    def _best(self, score: Samples, spread: float) -> Candidate | None:
        """The lag of the highest peak."""
        at = int(np.argmax(score))
        lag = at - self._early
        heard = self._at - self._since - max(lag, 0)
        if spread <= 0.0 or heard < MINIMUM:
            return None
        earlier, later = score[: max(at - NEAR, 0)].max(initial=0.0), score[at + REFLECTIONS :].max(initial=0.0)
        second = max(earlier, REFLECTED * score[at + NEAR : at + REFLECTIONS].max(initial=0.0), later)
        height = float(score[at])
        return Candidate(lag, height / spread, height / max(float(second), 1e-12), self._at, heard)

    def before(self, number: int, mic: Tape, ref: Tape | Playback, found: Candidate) -> bool:
        """Whether a microphone's window BETWEEN samples before the one that the lag was found in shows it as well."""
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
        spread = float(np.sqrt(np.mean(np.square(score)))) + 1e-20
        return float(score[ASIDE - NEAR : ASIDE + NEAR].max()) / spread > SEEN

    def _whitened(self, heard: Samples, reference: np.ndarray, number: int) -> np.ndarray:
        """Cross-spectrum of what a microphone heard (n,) with the flattened reference, without rumble and its response's phase."""
        cross = flattened(fft.rfft(heard), 1e-6) * np.conj(reference)
        cross[: int(LOWEST_HZ * heard.size / SAMPLE_RATE)] = 0.0
        if self._signed:
            cross *= self._phases[heard.size][number]
        return cross

    def _overlap(self, late: int) -> Samples:
        """Energy of the reference, first difference, that falls under the microphone's window, at every COARSE-th lag."""
        last = self._total.size - 1
        lags = np.arange(0, self._lags, COARSE) - self._early
        upper = np.clip((self._size + late - lags) // COARSE, 0, last)
        lower = np.clip((self._start + late - lags) // COARSE, 0, last)
        return (self._total[upper] - self._total[lower]).astype(np.float32)


def _soften(x: Samples) -> None:
    """Fade both ends of x, of any length, in place: two hard cuts, whitened, would correlate with one another."""
    rise = _RISE[: x.size]
    x[: rise.size] *= rise
    x[x.size - rise.size :] *= rise[::-1]


def _phase(response: Samples, size: int) -> np.ndarray:
    """What takes the response's phase out of a cross-spectrum."""
    spectrum = np.conj(fft.rfft(np.roll(np.pad(response, (0, size - response.size)), -PRE_ROLL)))
    return (spectrum / np.maximum(np.abs(spectrum), 1e-12)).astype(np.complex64)
