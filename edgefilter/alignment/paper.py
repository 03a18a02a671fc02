"""The paper's alignment: where the first half second of an utterance correlates best with the recording."""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy import fft

from edgefilter.alignment.aligner import Aligned
from edgefilter.alignment.delay_line import DelayBuffer
from edgefilter.alignment.utterances import OnsetDetector
from edgefilter.types import SAMPLE_RATE, AlignmentState, AlignmentStats, Samples

TEMPLATE = SAMPLE_RATE // 2
"""Samples of the utterance that are searched for: the paper's first 0.5 s."""
STRIDE = 2048
"""Lags that are evaluated at a time."""
DECISIVE = 0.35
"""Normalised correlation above which the lag is taken at once: chance peaks of speech against other speech stay under 0.3."""
CREDIBLE = 0.1
"""Normalised correlation under which the utterance was not heard, and the last lag is kept."""


class PaperAligner:
    """Streams the paper's method: each utterance's lag from its first 0.5 s; until it is decided the last lag is kept.

    Same interface as Aligner, with whole-sample delays of the full lag (no pre-roll) and no tracking. A lag is decided
    when its normalised correlation is above DECISIVE, at the latest 0.5 s + the longest lag after the onset (Li et al.
    2024, section on alignment).
    """

    def __init__(self, hop: int) -> None:
        self.hop = hop
        self._max_lag = int(1.6 * SAMPLE_RATE)
        self._size = fft.next_fast_len(TEMPLATE + STRIDE, real=True)
        length = self._max_lag + TEMPLATE + 4 * SAMPLE_RATE
        self._mic, self._ref = DelayBuffer(length), DelayBuffer(length)
        self._onsets = OnsetDetector(hop)
        self._waiting: deque[int] = deque(maxlen=16)
        self._delay: int | None = None
        self._confidence = 0.0
        self._decided = 0
        self._begin(None)

    def announce(self, utterance: Samples) -> bool:
        """Accepted and not needed: the reference itself comes before the microphone hears it."""
        return True

    def step(self, mic: Samples, ref: Samples) -> Aligned:
        """Take a hop (hop,) of both and return the reference as the microphone hears it."""
        self._mic.push(mic)
        self._ref.push(ref)
        started = self._onsets.step(ref)
        if started:
            self._waiting.append(max(started.start, 0))
        before = self._delay
        self._search()
        state: AlignmentState = "begun" if self._onset is not None else "idle" if self._delay is None else "locked"
        delay, moved = float("nan") if self._delay is None else float(self._delay), self._delay != before
        return Aligned(self.history(self.hop), delay, 0.0, self._confidence, state, moved)

    def history(self, count: int) -> Samples:
        """The last count aligned samples under the present delay, (count,) float32."""
        if self._delay is None:
            return np.zeros(count, np.float32)
        end = self._ref.end - self._delay
        return self._ref.read(end - count, end).copy()

    def stats(self) -> AlignmentStats:
        """What was found so far, ready for JSON."""
        return {
            "method": "paper",
            "delay_samples": self._delay,
            "confidence": self._confidence,
            "utterances_aligned": self._decided,
        }

    def _begin(self, onset: int | None) -> None:
        self._onset = onset
        self._scanned, self._best, self._best_lag = 0, 0.0, 0

    def _search(self) -> None:
        if self._onset is None and self._waiting:
            self._begin(self._waiting.popleft())
        if self._onset is not None and self._ref.end >= self._onset + self._scanned + STRIDE + TEMPLATE:
            self._scan(self._ref.read(self._onset, self._onset + TEMPLATE), self._onset + self._scanned)

    def _scan(self, template: Samples, at: int) -> None:
        """Evaluate the next STRIDE lags, whose half second of microphone, from at on, is now complete (overlap-save)."""
        mic = self._mic.read(at, at + STRIDE + TEMPLATE - 1)
        cross = fft.rfft(mic, self._size) * np.conj(fft.rfft(template, self._size))
        total = np.concatenate(([0.0], np.cumsum(np.square(mic, dtype=np.float64))))
        energy = (total[TEMPLATE:] - total[:-TEMPLATE] + 1e-9) * (float(np.dot(template, template)) + 1e-9)
        score = fft.irfft(cross, self._size)[:STRIDE] / np.sqrt(energy)
        lag = int(np.argmax(score))
        if score[lag] > self._best:
            self._best, self._best_lag = float(score[lag]), self._scanned + lag
        self._scanned += STRIDE
        if self._best > DECISIVE or self._scanned >= self._max_lag:
            if self._best > CREDIBLE:
                self._delay, self._confidence = self._best_lag, self._best
                self._decided += 1
            self._begin(None)
