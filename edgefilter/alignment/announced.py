"""Utterances that the robot said it would play: they stand in for a reference channel that stays silent."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from edgefilter.alignment.utterances import FLOOR
from edgefilter.types import SAMPLE_RATE, Samples

LEAD = SAMPLE_RATE
"""Samples before now at which the playback is supposed to have begun: an utterance is recognised while its first second
is heard."""
AHEAD = 4096
"""Samples by which an utterance that was heard goes ahead of the microphone, so that the tracker sees to both sides."""
PATIENCE = 30 * SAMPLE_RATE
"""Samples of silence for which an announced utterance is waited for."""


@dataclass(frozen=True, slots=True)
class Playback:
    """An utterance whose first sample lies at position start; it can be read like a tape."""

    utterance: Samples
    start: int

    @property
    def end(self) -> int:
        """Position behind the last sample."""
        return self.start + self.utterance.size

    def read(self, start: int, stop: int) -> Samples:
        """Samples start..stop-1 (stop - start,), zeros where the utterance is not."""
        out = np.zeros(stop - start, np.float32)
        first, last = max(start, self.start), min(stop, self.end)
        if last > first:
            out[first - start : last - start] = self.utterance[first - self.start : last - self.start]
        return out


class Announcements:
    """The utterances announced so far, in the order in which they will be played, and the one that is being played.

    A reference channel that carries sound is believed instead: then all of them are dropped.
    """

    def __init__(self) -> None:
        self._waiting: deque[Samples] = deque()
        self._playing: Playback | None = None
        self._since: int | None = None

    def add(self, utterance: Samples) -> None:
        """Queue an utterance (n,); the silence before its first sound does not count, and one without any sound is left out."""
        loud = np.flatnonzero(np.abs(utterance) > max(0.01 * float(np.abs(utterance).max(initial=0.0)), FLOOR**0.5))
        if loud.size:
            self._waiting.append(np.array(utterance[max(loud[0] - 256, 0) : loud[-1] + 1], np.float32))

    def reference(self, ref: Samples, now: int) -> Samples:
        """The reference (n,) for the hop that begins at position now: the channel's own, or what is being played."""
        if (self._waiting or self._playing) and float(ref.dot(ref)) > FLOOR * ref.size:
            self._waiting.clear()
            self._playing = None
        if self._playing is None:
            return ref
        played = self._playing.read(now, now + ref.size)
        if now + ref.size >= self._playing.end:
            self._playing, self._since = None, None
        return played

    def expected(self, now: int) -> Playback | None:
        """The utterance to look for in the microphone up to position now, as if it had begun LEAD samples ago.

        None if there is none.
        """
        if not self._waiting or self._playing is not None:
            return None
        self._since = now if self._since is None else self._since
        if now - self._since > PATIENCE:
            self._waiting.popleft()
            self._since = None
            return self.expected(now)
        return Playback(self._waiting[0], now - LEAD)

    def begin(self, heard_at: int) -> Playback:
        """The first one waiting was heard to begin at position heard_at.

        Returns where it then lies in the reference.
        """
        self._playing = Playback(self._waiting.popleft(), heard_at - AHEAD)
        return self._playing
