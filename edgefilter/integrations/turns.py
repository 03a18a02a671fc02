"""The human's turns for a recogniser that takes each as a whole: the finished one, in place of what was streamed."""

from __future__ import annotations

from collections import deque

import numpy as np

from edgefilter.dsp.resample import Resampler
from edgefilter.filter.turns import BEFORE_S, LONGEST_S
from edgefilter.integrations.duplex import Duplex
from edgefilter.types import SAMPLE_RATE, Event, Samples, Turn


class TurnByTurn:
    """Collects what one recogniser is to get: `start` with a turn, `hear` what is streamed, `take` it at the end.

    These are the turns that the filter has finished meanwhile, the latest eight. Where there is none, since the filter is
    off or another detector was sooner, it is what was streamed, with half a second before the start, 30 s at most.

    >>> import numpy as np
    >>> from edgefilter import EgoFilter
    >>> turns = TurnByTurn(Duplex(EgoFilter(engine="linear")))
    >>> turns.start()
    >>> turns.hear(np.ones(480, np.float32), 48_000)
    >>> turns.take()[0].size, turns.take()[0].size
    (480, 0)
    """

    def __init__(self, duplex: Duplex) -> None:
        self._duplex = duplex
        self._finished: deque[Turn] = deque(maxlen=8)
        self._streamed: deque[Samples] = deque()
        self._count, self._first, self._rate, self._open = 0, 0, SAMPLE_RATE, False
        duplex.listeners.append(self._note)

    def close(self) -> None:
        """Collect no more."""
        self._duplex.listeners.remove(self._note)

    def start(self, first: int = 0) -> None:
        """The recogniser's turn begins. first: the sample of the microphone, at 16 kHz, from which on it is wanted."""
        self._finished.clear()
        self._first, self._open = first, True

    def hear(self, samples: Samples, rate: int) -> None:
        """Take what was streamed, (n,) at rate."""
        self._rate = rate
        if not samples.size:
            return
        self._streamed.append(samples)
        self._count += samples.size
        most = round((LONGEST_S if self._open else BEFORE_S) * rate)
        while self._count - self._streamed[0].size > most:
            self._count -= self._streamed.popleft().size

    def take(self) -> tuple[Samples, int]:
        """The turn (n,), and its rate, that of what was streamed; with it the turn is over."""
        finished = [self._finished.popleft() for _ in range(len(self._finished))]
        streamed = list(self._streamed)
        self._streamed.clear()
        self._count, self._open = 0, False
        if not finished:
            return np.concatenate(streamed) if streamed else np.zeros(0, np.float32), self._rate
        samples = np.concatenate([turn.samples[max(self._first - turn.start, 0) :] for turn in finished])
        return Resampler(SAMPLE_RATE, self._rate).push(samples, last=True), self._rate

    def _note(self, event: Event) -> None:
        if event.turn is not None and self._duplex.enabled:
            self._finished.append(event.turn)
