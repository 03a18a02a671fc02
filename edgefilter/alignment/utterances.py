"""The robot's utterances: where they begin in the reference, those announced before, and the sounds that come before their lag."""

from __future__ import annotations

import math
import sys
from collections import deque
from dataclasses import dataclass

import numpy as np

from edgefilter.dsp.frames import SILENT, stretch
from edgefilter.types import SAMPLE_RATE, AlignmentState, Samples

PAUSE = SAMPLE_RATE // 5
"""Samples of silence in the reference after which the lag may have changed: shorter than any pause between two playbacks, longer than
the closure of a plosive."""
LAST_BIT = 2.0**-46
"""Mean square of a 24-bit converter's last bit, -138 dB of full scale: a reference that has less is silent."""
SUSTAINED = 3
"""Hops that a level must last to be the voice's: 48 ms, a short vowel. A click falls into two at most."""
VARIES = 10**1.5
"""A voice's loudest hop is so much louder than its softest, 15 dB; those of a noise are alike. Of 150 synthetic voices that rise
out of digital silence 9 in 10 vary so within 80 ms, with all below a hundredth of their peak cut off in front within 0.26 s."""
NEVER = -sys.maxsize
"""A position long before the first sample."""
LEAD = SAMPLE_RATE
"""Samples before the present one at which an announced utterance is assumed to have begun: its echo is found in its first second."""
AHEAD = 4096
"""Samples by which an utterance that was heard goes ahead of the microphone, so that the tracker sees to both sides."""
PATIENCE = 30 * SAMPLE_RATE
"""Samples of silence for which an announced utterance is waited for."""
MOST_ANNOUNCED, MOST_ANNOUNCED_S = 64, 300
"""Utterances that may wait, and seconds of them, 19 MB: longer than any answer, also where each word is announced apart."""
LOUD, EXPLAINED = 0.05, 100.0
"""Microphone power from which on it can only be the robot, over the robot's loudest there; a human 20-26 dB below it is 7 to
13 dB softer. Microphone power, over that of the echo at the present delay, from which on this delay is not the right one;
single sounds pass a room up to 10 dB better than speech does."""
LONGEST = SAMPLE_RATE // 4
"""Longest muting, samples, once the robot has been heard: it limits what a human as loud as the robot can lose. A reference that
rises out of digital silence counts as a voice for as long, before its level has varied."""
RECENT = SAMPLE_RATE // 2
"""Samples for which somebody else who was loud may pause within a sentence: with half as many a real human as loud as the robot lost 2 dB."""
USUAL = 1e-2
"""Initial peak of a voice, mean square, -20 dB: so that a soft onset does not lower the threshold."""
LEARNING = 0.1
"""Share of a loud hop in the running gain from the reference to the microphone."""


@dataclass
class Utterance:
    """A stretch of speech in the reference, positions in samples; start lies up to two hops before the first sound.

    after: end of the one before it, which the microphone hears out first, since one loudspeaker plays them in turn.
    lost: whether it is one that was followed and is looked for again, not one that began; nearby: how many more
    searches assume that its lag jumped only lately, and move its start along. refuted: whether it is not heard at the lag of before.
    """

    start: int
    end: int
    after: int = NEVER
    nearby: int = 0
    lost: bool = False
    refuted: bool = False


class Sustained:
    """Loudness of a voice in which clicks do not count: the level that it keeps up for a short vowel."""

    def __init__(self) -> None:
        self._powers = deque([0.0] * SUSTAINED, maxlen=SUSTAINED)

    def step(self, power: float) -> float:
        """Take the power of the next hop; the least of the last SUSTAINED."""
        self._powers.append(power)
        return min(self._powers)


class OnsetDetector:
    """Cuts the reference into utterances, hop by hop.

    current: the latest utterance; before the first, one with times long past stands for it. peak, least: mean square of the loudest and
    of the softest hop, which are forgotten within some ten seconds; least skips hops of zeros, which devices deliver when they start.
    """

    def __init__(self, hop: int) -> None:
        self._hop = hop
        self._sustained = Sustained()
        self.peak, self.least = 0.0, float("inf")
        self._decay = 0.1 ** (hop / (10.0 * SAMPLE_RATE))
        self.now, self._silence = 0, NEVER  # where the last digitally silent hop ended
        self.current = Utterance(NEVER, NEVER)
        self.active = False

    @property
    def varies(self) -> bool:
        """Whether the reference varies as a voice does, and is no mere noise of a loopback; at first, if it rose out of nothing."""
        risen = self.peak > 0.0 and self.now - self._silence <= LONGEST
        return risen or self.peak > VARIES * self.least

    def step(self, ref: Samples) -> Utterance | None:
        """Take a hop (hop,) and return the utterance that begins with it, if one does; `current` grows while it lasts."""
        self.now += self._hop
        power = float(ref.dot(ref)) / self._hop
        self.peak = max(self._sustained.step(power), self.peak * self._decay)
        if power > LAST_BIT:
            # of a hop in which a device begins, or leaves a hole, its noise is in the samples that are there
            softest = power * self._hop / int(np.count_nonzero(ref))
            self.least = min(softest, self.least / self._decay)
        else:
            self._silence = self.now
        self.active = power > max(LAST_BIT, SILENT * self.peak)
        if not self.active:
            return None
        fresh = self.now - self.current.end > PAUSE
        if fresh:
            self.current = Utterance(self.now - 2 * self._hop, self.now, self.current.end)
        self.current.end = self.now
        return self.current if fresh else None


@dataclass(frozen=True, slots=True)
class Playback:
    """An utterance whose first sample lies at position start; it can be read like a buffer."""

    utterance: Samples
    start: int

    @property
    def end(self) -> int:
        """Position after the last sample."""
        return self.start + self.utterance.size

    def read(self, start: int, stop: int) -> Samples:
        """Samples start..stop-1 (stop - start,), zeros where the utterance is not."""
        return stretch(self.utterance, start - self.start, stop - self.start)


class Announcements:
    """Utterances that the robot said it would play, in this order, for a reference channel that stays silent.

    Each is looked for in the microphone for PATIENCE, and from where it is heard on it is the reference. A channel that carries
    sound is believed instead: then all of them are dropped.
    """

    def __init__(self) -> None:
        self._waiting: deque[Samples] = deque()
        self._playing: Playback | None = None
        self._since: int | None = None

    def add(self, utterance: Samples) -> bool:
        """Queue an utterance (n,), without the silence that it begins with; one that is all silence is skipped.

        Returns False, and queues nothing, if more than MOST_ANNOUNCED utterances or MOST_ANNOUNCED_S seconds would wait.
        """
        loud = np.flatnonzero(np.abs(utterance) > max(0.01 * float(np.abs(utterance).max(initial=0.0)), LAST_BIT**0.5))
        sound = utterance[max(loud[0] - 256, 0) : loud[-1] + 1] if loud.size else utterance[:0]
        waiting = sum(map(len, (*self._waiting, sound)))
        if len(self._waiting) >= MOST_ANNOUNCED or waiting > MOST_ANNOUNCED_S * SAMPLE_RATE:
            return False
        if sound.size:
            self._waiting.append(np.array(sound, np.float32))
        return True

    def reference(self, ref: Samples, now: int) -> Samples:
        """The reference (n,) for the hop that begins at position now: the channel's own, or what is being played."""
        if (self._waiting or self._playing) and float(ref.dot(ref)) > LAST_BIT * ref.size:
            self._waiting.clear()
            self._playing = None
        if self._playing is None:
            return ref
        played = self._playing.read(now, now + ref.size)
        if now + ref.size >= self._playing.end:
            self._playing, self._since = None, None
        return played

    def expected(self, now: int) -> Playback | None:
        """The utterance to look for in the microphone up to now, as if it had begun LEAD samples ago; None if there is none."""
        if not self._waiting or self._playing is not None:
            return None
        self._since = now if self._since is None else self._since
        if now - self._since > PATIENCE:
            self._waiting.popleft()
            self._since = None
            return self.expected(now)
        return Playback(self._waiting[0], now - LEAD)

    def begin(self, heard_at: int) -> Playback:
        """Where the first one waiting, which was heard to begin at heard_at, lies in the reference from now on."""
        self._playing = Playback(self._waiting.popleft(), heard_at - AHEAD)
        return self._playing


class FirstSounds:
    """Tells, by its level, whether the microphone holds the robot at another delay than the present one.

    hop: samples per step. response: (taps,), calibrated impulse response from the reference to the microphone; without one nothing
    is told until the robot has been heard.
    """

    def __init__(self, hop: int, response: Samples | None) -> None:
        self._hop = hop
        self._gain = math.inf if response is None else float(np.sum(np.square(response)))
        self._heard, self._since, self._before = False, 0, 0

    def step(self, mic: Samples, explained: Samples, loudest: float, state: AlignmentState, waits: bool) -> bool:
        """Take a hop mic (hop,); whether its sound is the robot at another delay.

        explained: (hop,), the reference at the present delay, zeros while none is known. loudest: mean square of the
        reference's loudest hop so far. waits: whether the delay of an utterance is still to be found.
        """
        power, brought = float(np.dot(mic, mic)), float(np.dot(explained, explained))
        if state == "locked" and brought > 0.1 * self._hop * loudest:
            self._heard = True
            before = power / brought if math.isinf(self._gain) else self._gain
            self._gain = before + LEARNING * (min(power / brought, 2.0 * before) - before)
        least = LOUD * self._hop * (loudest if self._heard else max(loudest, USUAL))
        loud = power > self._gain * max(least, EXPLAINED * brought)
        if not waits:
            self._since, self._before = 0, RECENT if loud else max(self._before - self._hop, 0)
            return False
        # a sound that was as loud before the robot's utterance began is not the robot's
        if self._since or (loud and not self._before):
            self._since += self._hop
        return 0 < self._since <= (LONGEST if self._heard else np.inf)
