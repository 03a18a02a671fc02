"""How loud the predicted echo is in the microphone: a volume that was turned, and an echo that is too loud to be subtracted.

The numbers were checked with `linear` on 63 recordings, simulated and real, with and without a calibration.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from edgefilter.types import SAMPLE_RATE, Samples

MEMORY = 0.8
"""Weight of the past in the smoothed moments, per hop of 16 ms: about 80 ms."""
EXCESS = 1.5
"""Ratio of the error's power to that of the microphone, or to the error with another volume, above which the gain is wrong."""
PATIENCE_S = 0.5
"""Seconds within which a suspected change of volume must be confirmed, and after it for as long none is suspected. Also: seconds for which an
echo must be louder than predicted until the path counts as changed."""
COHERENCE = 0.3
"""Least squared correlation coefficient of echo and microphone at which a volume is suspected: less may be chance."""
NOTICED = 1e-3
"""Error power over the microphone's, -30 dB, from which on a volume is suspected; 0.3 dB of volume leave that."""
AUDIBLE, FORGET_S = 0.01, 10.0
"""The robot is audible where its power is within 20 dB of its recent peak, which fades by 10 dB in FORGET_S seconds."""
MOST = 10.0
"""Largest factor of amplitude, 20 dB, by which the volume is followed up or down from its first value. Also: factor by which a path that began
unknown must have lowered the microphone's power, 10 dB, before its volume is trusted."""
PRE_EMPHASIS = 0.95
"""Coefficient of the first-order pre-emphasis before the volume is estimated and paths are compared, so that noise and rumble below the
voice weigh less. Without it where the volume is estimated, two of 63 recordings, simulated and real, are filtered 0.8 dB worse, and none better."""
WITNESSES = 6
"""Audible hops, about 100 ms, that make one piece of evidence; a suspected factor proves itself on later ones."""
PART = 64
"""Samples, 4 ms, of a hop that are limited by themselves: a loudspeaker can be cut off in mid-word."""
GROSS = 4.0
"""Error power of such a part over the microphone's from which on it is limited whatever the smoothed moments say: human
and robot cancel one another in the microphone by so much in hardly any part."""
ABSENT = 0.1
"""Weight below which the echo is not there at all: so much of a correlation is chance."""


class Moments(NamedTuple):
    """Second moments of microphone and predicted echo: <mic, mic>, <mic, echo> and <echo, echo>."""

    mic: float = 0.0
    cross: float = 0.0
    echo: float = 0.0

    @classmethod
    def of(cls, mic: Samples, echo: Samples) -> Moments:
        """Of one hop (hop,)."""
        return cls(float(mic.dot(mic)), float(mic.dot(echo)), float(echo.dot(echo)))

    def smoothed(self, now: Moments) -> Moments:
        """These, followed by those of the next hop."""
        return Moments(*(MEMORY * before + (1.0 - MEMORY) * new for before, new in zip(self, now)))

    def plus(self, now: Moments) -> Moments:
        """The sums of both."""
        return Moments(*(before + new for before, new in zip(self, now)))

    def left(self, factor: float = 1.0) -> float:
        """Power of mic - factor * echo."""
        return self.mic - 2.0 * self.cross * factor + self.echo * factor * factor


class Volume:
    """Follows the volume of the robot's voice: one factor on the whole echo path, believed only on evidence.

    hop: samples per step. path: "known"; "unknown" where it has yet to be learnt; "unscaled" where the scale of microphone
    and reference is found first, hop by hop; "tried" while a factor is. gain: product of all factors so far.
    """

    def __init__(self, hop: int, path: Literal["known", "unknown", "unscaled"] = "known", gain: float = 1.0) -> None:
        self._forget = 0.1 ** (hop / (FORGET_S * SAMPLE_RATE))
        self._patience = round(PATIENCE_S * SAMPLE_RATE / hop)
        self._path: Literal["known", "unknown", "unscaled", "tried"] = path
        self._peak = 0.0
        self._smoothed = self._since = Moments()
        self._factor, self._count, self._age, self._rest = 1.0, 0, 0, 0
        self.gain, self._first = gain, 1.0

    @property
    def suspected(self) -> bool:
        """Whether a factor is being looked for or tried: the path is better left as it is until then."""
        return self._path in ("unscaled", "tried")

    def follow(self, mic: Samples, echo: Samples) -> float:
        """The factor by which the echo path is to be scaled now, 1 where nothing says so. mic, echo: (hop,)."""
        now = Moments.of(pre_emphasised(mic), pre_emphasised(echo))
        self._peak = max(now.echo, self._forget * self._peak)
        self._smoothed = self._smoothed.smoothed(now)
        audible = now.echo > AUDIBLE * self._peak
        if self._path == "unknown":
            if audible and self._smoothed.mic > MOST * self._smoothed.left():
                self._path = "known"
        elif self._path == "unscaled":
            return self._scale(now) if audible and now.mic else 1.0
        elif self._path == "tried":
            return self._confirm(now, audible)
        elif self._rest:
            self._rest -= 1
        elif self._suspicious(self._smoothed):
            self._path, self._since = "tried", Moments()
        return 1.0

    def _scale(self, now: Moments) -> float:
        """Bring the echo to the scale of what is heard: never louder, and from as many hops on as prove a factor by that.

        Where twice as many do not agree the path is another one, and its scale is left to the adaptation.
        """
        self._since = since = self._since.plus(now)
        self._count += 1
        if since.echo > EXCESS * since.mic:
            return self._turn(math.sqrt(since.mic / since.echo))
        agree = self._count >= WITNESSES and _coherent(since)
        if not agree and self._count < 2 * WITNESSES:
            return 1.0
        factor = since.cross / since.echo
        factor = self._turn(factor) if agree and since.left() > EXCESS * since.left(factor) else 1.0
        self._first = self.gain
        self._drop()
        return factor

    def _suspicious(self, found: Moments) -> bool:
        """Whether one factor on the echo explains much of the error."""
        if found.echo <= AUDIBLE * self._peak or not _coherent(found):
            return False
        self._factor = self._bounded(found.cross / found.echo)
        return found.left() > max(NOTICED * found.mic, EXCESS * found.left(self._factor))

    def _confirm(self, now: Moments, audible: bool) -> float:
        """Test the suspected factor by what it leaves of the hops after those that it was found in."""
        self._age += 1
        if audible:
            self._since = self._since.plus(now)
            self._count += 1
        if self._count < WITNESSES:
            if self._age > self._patience:
                self._drop()
            return 1.0
        since, suspected = self._since, self._factor
        self._drop()
        self._rest = self._patience
        if since.left() <= EXCESS * since.left(suspected) or not _coherent(since):
            return 1.0
        return self._turn(self._bounded(since.cross / since.echo))

    def _turn(self, factor: float) -> float:
        self._peak *= factor**2
        self.gain *= factor
        self._since, self._count = Moments(), 0
        return factor

    def _bounded(self, factor: float) -> float:
        turned = self.gain / self._first
        return min(max(factor, 1.0 / (MOST * turned)), MOST / turned)

    def _drop(self) -> None:
        self._path, self._count, self._age, self._smoothed = "known", 0, 0, Moments()


class EchoLimiter:
    """Weighs the echo by gamma = <mic, echo> / <echo, echo>, in 0 to 1, while subtracting all of it would add power.

    hop: samples per step. changed: the path must have become another one, told in one hop each time.
    """

    def __init__(self, hop: int) -> None:
        self._part = math.gcd(hop, PART)
        self._ramp: Samples = np.arange(1, self._part + 1, dtype=np.float32) / np.float32(self._part)
        self._patience = round(PATIENCE_S * SAMPLE_RATE / hop)
        self._smoothed = Moments()
        self._weights = np.ones(hop // self._part + 1, np.float32)
        self._limited = False
        self._waited = 0
        self.changed = False

    @property
    def heard(self) -> np.float32:
        """How much of the echo is in the microphone, 0 to 1."""
        return np.float32(_weight(self._smoothed.cross / self._smoothed.echo)) if self._smoothed.echo else np.float32(0)

    def measure(self, mic: Samples, echo: Samples) -> bool:
        """Take a hop (hop,) of the microphone and of the predicted echo; whether some part of that is louder than the microphone allows."""
        now = Moments.of(mic, echo)
        self._smoothed = self._smoothed.smoothed(now)
        self._waited = self._waited + 1 if now.left() > EXCESS * now.mic else max(self._waited - 1, 0)
        self.changed = self._waited >= self._patience
        if self.changed:
            self._waited = 0
        self._weights[0] = self._weights[-1]
        self._weights[1:] = 1.0
        if now.left() > now.mic and self._smoothed.left() > self._smoothed.mic:
            self._weights[1:] = _weight(now.cross / now.echo)
        m, e = mic.reshape(-1, self._part), echo.reshape(-1, self._part)
        heard, cross, expected = (np.einsum("ij,ij->i", a, b) for a, b in ((m, m), (m, e), (e, e)))
        gross = heard - 2.0 * cross + expected > GROSS * heard
        if gross.any():
            self._weights[1:][gross] = np.minimum(self._weights[1:][gross], _weight(cross[gross] / expected[gross]))
        self._limited = bool(self._weights.min() < 1.0)
        return self._limited

    def turn(self, factor: float) -> None:
        """The echo is factor times what it was."""
        mic, cross, echo = self._smoothed
        self._smoothed = Moments(mic, cross * factor, echo * factor**2)

    def apply(self, echo: Samples) -> Samples:
        """The echo (hop,) with its weight, which falls at once and rises over a part."""
        if not self._limited:
            return echo
        target = self._weights[1:]
        start = np.minimum(self._weights[:-1], target)
        gain = start[:, None] + (target - start)[:, None] * self._ramp
        return gain.ravel() * echo


def pre_emphasised(x: Samples) -> Samples:
    """Pre-emphasise x (..., n) to (..., n - 1)."""
    return x[..., 1:] - PRE_EMPHASIS * x[..., :-1]


def _coherent(found: Moments) -> bool:
    """Whether predicted echo and microphone are coherent enough to compare their levels."""
    return found.cross > 0.0 and found.cross**2 >= COHERENCE * found.mic * found.echo


def _weight(part: float | np.ndarray) -> np.ndarray:
    """The echo's weight where so much of it is heard."""
    return np.where(part < ABSENT, 0.0, np.minimum(part, 1.0))
