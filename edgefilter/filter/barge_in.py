"""When the human began and stopped speaking, from the engine's probability: what a robot that can be interrupted waits for."""

from __future__ import annotations

STARTED, STARTED_HOPS = 0.95, 3
"""Probability that so many hops in a row reach when somebody has begun to speak. On 48 validation conversations 134 ms (median) after
the human's first sound, and a false alarm in three minutes of the robot alone; 0.9 and 2 hops: 100 ms, and two."""
STOPPED, PAUSE_S = 0.5, 0.5
"""Probability below which a hop is silent, and how long the silence lasts when somebody has stopped."""


class BargeIn:
    """Turns one stream's probabilities into beginnings and ends of speech.

    hop_s: seconds between two probabilities.

    >>> talk = BargeIn(0.016)
    >>> [talk.note(probability) for probability in (0.2, 0.99, 0.99, 0.99)]
    [None, None, None, 'speech_started']
    """

    def __init__(self, hop_s: float) -> None:
        self._pause = round(PAUSE_S / hop_s)
        self._sure = self._silent = 0
        self.speaking = False

    def note(self, probability: float | None) -> str | None:
        """Take the probability of a hop, None where the engine does not judge it; return 'speech_started' or 'speech_stopped' or None."""
        probability = probability or 0.0
        self._sure = self._sure + 1 if probability >= STARTED else 0
        self._silent = self._silent + 1 if probability < STOPPED else 0
        if not self.speaking and self._sure >= STARTED_HOPS:
            self.speaking = True
            return "speech_started"
        if self.speaking and self._silent >= self._pause:
            self.speaking = False
            return "speech_stopped"
        return None
