"""A volume that was turned: one common factor on the whole echo path, believed only on evidence."""

from __future__ import annotations

from typing import TypeAlias

from edgefilter.types import SAMPLE_RATE, Samples

Powers: TypeAlias = tuple[float, float, float]
"""<mic, mic>, <mic, echo> and <echo, echo>."""

MEMORY = 0.8
"""Weight of the past in the correlation of microphone and echo per hop of 16 ms; about 80 ms."""
EXCESS = 1.5
"""A volume was turned where one common factor on the echo lowers the error's power by more than this factor ..."""
NOTICED = 1e-3
"""... and which is more than this part of the microphone's, -30 dB; 0.3 dB of volume leave that ..."""
COHERENCE = 0.3
"""... where echo and microphone agree by at least this much, squared correlation coefficient ..."""
AUDIBLE, FORGET_S = 0.01, 10.0
"""... and where the echo is within 20 dB of its recent peak, which fades by 10 dB in FORGET_S seconds."""
MOST = 10.0
"""Largest factor, 20 dB, by which the volume is followed from where it was at first, up or down."""
CONVERGED = 10.0
"""Factor by which an echo path that began unknown must have lowered the microphone's power before a factor on it means
anything."""
PRE_EMPHASIS = 0.95
"""First-order pre-emphasis before the correlation: fan and room rumble below the voice weigh less."""
WITNESSES = 6
"""Hops of audible robot, about 100 ms, on which a suspected factor must prove itself; it was not found in them."""
PATIENCE = 25
"""Hops, 0.4 s, in which the witnesses must come, and in which nothing is suspected after a suspicion has ended."""
SILENCE = 1e-10
"""Mean square of an echo that is none."""
NOTHING: Powers = (0.0, 0.0, 0.0)


class Volume:
    """Follows the volume of the robot's voice by the correlation of the microphone with the predicted echo.

    hop: samples per step. known: whether the path is, or has yet to be learnt. gain: product of all factors so far.
    suspected: a factor is being tried, the path is better left as it is until then.
    """

    def __init__(self, hop: int, known: bool = True) -> None:
        self._hop = hop
        self._forget = 0.1 ** (hop / (FORGET_S * SAMPLE_RATE))
        self._known = known
        self._peak = 0.0
        self._powers = NOTHING
        self.suspected, self._factor, self._count, self._age, self._rest = False, 1.0, 0, 0, 0
        self._since = NOTHING
        self.gain = 1.0

    def follow(self, mic: Samples, echo: Samples) -> float:
        """The factor by which the echo path is to be scaled now, 1 where nothing says so. mic, echo: (hop,)."""
        m, e = mic[1:] - PRE_EMPHASIS * mic[:-1], echo[1:] - PRE_EMPHASIS * echo[:-1]
        now = float(m.dot(m)), float(m.dot(e)), float(e.dot(e))
        self._peak = max(now[2], self._forget * self._peak)
        before = self._powers
        heard = MEMORY * before[0] + (1.0 - MEMORY) * now[0]
        cross = MEMORY * before[1] + (1.0 - MEMORY) * now[1]
        expected = MEMORY * before[2] + (1.0 - MEMORY) * now[2]
        self._powers = heard, cross, expected
        if not self._known:
            self._known = heard > CONVERGED * _left(heard, cross, expected, 1.0) and now[2] > SILENCE * self._hop
            return 1.0
        if self.suspected:
            return self._confirm(now)
        self._rest = max(self._rest - 1, 0)
        if not self._rest and self._suspicious(heard, cross, expected):
            self.suspected, self._since = True, NOTHING
        return 1.0

    def _suspicious(self, heard: float, cross: float, expected: float) -> bool:
        """Whether one factor on the echo explains much of the error, given <mic, mic>, <mic, echo> and <echo, echo>."""
        if cross <= 0.0 or expected <= max(SILENCE * self._hop, AUDIBLE * self._peak):
            return False
        if cross * cross < COHERENCE * heard * expected:
            return False
        self._factor = self._bounded(cross / expected)
        error = _left(heard, cross, expected, 1.0)
        return error > max(NOTICED * heard, EXCESS * _left(heard, cross, expected, self._factor))

    def _confirm(self, now: Powers) -> float:
        """Judge the suspected factor by what it leaves of the hops after those that it was found in."""
        if now[2] > AUDIBLE * self._peak:
            before = self._since
            self._since = before[0] + now[0], before[1] + now[1], before[2] + now[2]
            self._count += 1
        self._age += 1
        if self._count < WITNESSES:
            if self._age > PATIENCE:
                self._drop()
            return 1.0
        since, suspected = self._since, self._factor
        self._drop()
        self._rest = PATIENCE
        if _left(*since, 1.0) <= EXCESS * _left(*since, suspected) or since[1] ** 2 < COHERENCE * since[0] * since[2]:
            return 1.0
        factor = self._bounded(since[1] / since[2])
        self._peak *= factor**2
        self.gain *= factor
        return factor

    def _bounded(self, factor: float) -> float:
        return min(max(factor, 1.0 / (MOST * self.gain)), MOST / self.gain)

    def _drop(self) -> None:
        self.suspected, self._count, self._age, self._powers = False, 0, 0, NOTHING


def _left(heard: float, cross: float, expected: float, factor: float) -> float:
    """Power of mic - factor * echo."""
    return heard - 2.0 * cross * factor + expected * factor * factor
