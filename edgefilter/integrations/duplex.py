"""The two directions of a voice agent's sound, as they come, brought to the microphone's sample counter and filtered.

An agent has no sample counter that both directions share: it hands speech over in bursts, faster than it is played,
late, or drops half of it when it is interrupted. Here the microphone is the clock. What was handed to the loudspeaker
waits in a queue, and every sample of the microphone takes one from it, as the loudspeaker does; what is dropped before
its turn was never played and is no reference. How much later it is heard, the filter's aligner finds.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TypedDict

import numpy as np
import soxr

from edgefilter.audio.raw import FULL_SCALE, to_pcm16
from edgefilter.errors import SignalError, UsageError
from edgefilter.filter.budget import DEFAULT_MS
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.types import SAMPLE_RATE, Event, Samples

MOST_QUEUED_S = 600.0
"""Speech that may wait to be played; what comes on top is counted and not believed: 40 MB is all that it may take."""
ABSENT_S = 1.0
"""A microphone that delivers nothing for so long was off, not late; what was played meanwhile nobody heard."""


class DuplexStats(TypedDict):
    """Seconds of sound: played, waiting, dropped unplayed, played unheard, refused; and how often speech ran out.

    gaps counts the ends of speech and the underruns within it alike: the agent does not say which it was.
    """

    played_s: float
    queued_s: float
    dropped_s: float
    unheard_s: float
    refused_s: float
    gaps: int


class Resampler:
    """One stream from one rate to another, piece by piece; it holds some 40 ms back, at equal rates nothing."""

    def __init__(self, source: int, target: int) -> None:
        self.rates = (source, target)
        self._stream = None if source == target else soxr.ResampleStream(source, target, 1, dtype="float32")

    def push(self, samples: Samples, last: bool = False) -> Samples:
        """Take the next samples (n,) and return what is finished; with last everything, and nothing may follow."""
        if self._stream is None or not (samples.size or last):
            return samples
        return self._stream.resample_chunk(samples, last=last)


class Duplex:
    """An EgoFilter between an agent's microphone and its loudspeaker, for frames of any length and rate.

    `play` and what changes the queue may be called from any thread, `hear` from one at a time.

    Parameters
    ----------
    ego : EgoFilter, optional
        The filter; unless given, one without a profile, with cheaper engines to step down to on a slow machine.
    patience_s : float
        How long the microphone waits for speech that is late while the robot talks. For agents that hand over speech no
        earlier than it is played, whose frames therefore jitter around their turn; 0 where they are ahead.
    on_event : callable, optional
        Called with each `Event` of the filter, in the thread of `hear`. Without it they are kept for `ego.events()`.
    clock : callable
        Seconds, monotonic.

    Raises
    ------
    UsageError
        For an engine that answers only at the end of a recording.

    Examples
    --------
    >>> import numpy as np
    >>> duplex = Duplex(EgoFilter(engine="linear"))
    >>> duplex.play(np.zeros(24_000, np.float32), 24_000)  # a second of speech at once
    >>> sum(duplex.hear(np.zeros(480, np.float32), 48_000).size for _ in range(50)) > 20_000
    True
    """

    def __init__(
        self,
        ego: EgoFilter | None = None,
        patience_s: float = 0.0,
        on_event: Callable[[Event], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.ego = EgoFilter(budget_ms=DEFAULT_MS) if ego is None else ego
        if self.ego.waits_for_end:
            raise UsageError(
                f"engine {self.ego.engine_name} needs the whole recording before it answers: an agent needs another"
            )
        self._patience = round(patience_s * SAMPLE_RATE)
        self._on_event = on_event
        self._clock = clock
        self._queue_lock, self._hear_lock = threading.Lock(), threading.Lock()
        self._queue: deque[Samples] = deque()
        self._queued = self._played = self._dropped = self._unheard = self._refused = self._gaps = 0
        self._from_agent = Resampler(SAMPLE_RATE, SAMPLE_RATE)
        self._from_mic, self._to_agent = (Resampler(SAMPLE_RATE, SAMPLE_RATE) for _ in range(2))
        self._mic = np.zeros(0, np.float32)
        self._talking = self._paused = False
        self._enabled = True
        self._talking_since = self._heard_at = clock()

    # what the agent says: any thread

    def play(self, samples: Samples, rate: int) -> None:
        """Say what is handed to the loudspeaker now, to be played after what was handed over before: (n,) at rate."""
        with self._queue_lock:
            if not self._enabled:
                return
            if not self._talking:
                self._talking, self._talking_since = True, self._clock()
            if self._from_agent.rates[0] != rate:
                self._finish()
                self._from_agent = Resampler(rate, SAMPLE_RATE)
            self._append(self._from_agent.push(samples))

    def end(self) -> None:
        """Say that the utterance is complete: the microphone need not wait for more of it."""
        with self._queue_lock:
            self._finish()
            self._talking = False

    def interrupt(self) -> None:
        """Say that what has not been played yet never will be: the robot fell silent in mid-word."""
        with self._queue_lock:
            self._from_agent = Resampler(*self._from_agent.rates)
            self._dropped += self._skip(self._queued)
            self._talking = False

    def pause(self) -> None:
        """Say that the loudspeaker stands still and goes on where it stopped."""
        self._paused = True

    def resume(self, skipped_s: float = 0.0) -> None:
        """Say that the loudspeaker goes on; skipped_s: of the speech that waits, what it leaves out."""
        with self._queue_lock:
            self._dropped += self._skip(round(skipped_s * SAMPLE_RATE))
            self._paused = False

    # what the microphone hears: one thread at a time

    def hear(self, samples: Samples, rate: int) -> Samples:
        """Take the microphone's next samples (n,) at rate and return what is finished of the human, at the same rate.

        None, some or more than came in; in all as many, later by the filter's latency and, at another rate than 16 kHz,
        by the resamplers' 40 ms each way.
        """
        with self._hear_lock:
            if not self._enabled:
                return samples
            if self._from_mic.rates[0] != rate:
                self._from_mic, self._to_agent = Resampler(rate, SAMPLE_RATE), Resampler(SAMPLE_RATE, rate)
            self._mic = np.concatenate((self._mic, self._from_mic.push(samples)))
            with self._queue_lock:
                self._forget_unheard(samples.size / rate)
                reference = self._reference()
            mic, self._mic = self._mic[: reference.size], self._mic[reference.size :]
            human = self._to_agent.push(self.ego.process(mic, reference))
            events = self.ego.events() if self._on_event else []
        for event in events:
            if self._on_event:
                self._on_event(event)
        return human

    @property
    def enabled(self) -> bool:
        """Whether the microphone is filtered; while it is not, it passes as it is and what is played is not noted."""
        return self._enabled

    @enabled.setter
    def enabled(self, value: bool) -> None:
        self._enabled = value
        if not value:
            self.interrupt()

    @property
    def queued_s(self) -> float:
        """Seconds of speech that wait to be played."""
        return self._queued / SAMPLE_RATE

    def stats(self) -> DuplexStats:
        """What came of what the agent handed over; the filter's own are `ego.stats()`."""
        return {
            "played_s": self._played / SAMPLE_RATE,
            "queued_s": self._queued / SAMPLE_RATE,
            "dropped_s": self._dropped / SAMPLE_RATE,
            "unheard_s": self._unheard / SAMPLE_RATE,
            "refused_s": self._refused / SAMPLE_RATE,
            "gaps": self._gaps,
        }

    def close(self) -> None:
        """End the filter's learner, if it has one."""
        self.ego.close()

    def _reference(self) -> Samples:
        """What was played while the waiting microphone samples were heard; shorter where they wait on."""
        count = self._mic.size
        if self._paused:
            return np.zeros(count, np.float32)
        if self._talking and count > self._queued:
            if count - self._queued <= self._patience:
                count = self._queued
            else:
                self._finish()
                self._talking = False
                self._gaps += 1
        taken = self._take(count)
        self._played += taken.size
        return taken if taken.size == count else np.concatenate((taken, np.zeros(count - taken.size, np.float32)))

    def _forget_unheard(self, heard_s: float) -> None:
        """Skip what was played while the microphone was off.

        A microphone that was late instead delivers at once what it missed, and the reference is then early, which the
        aligner can find; one that came late it could not.
        """
        now, since = self._clock(), max(self._heard_at, self._talking_since)
        self._heard_at = now
        if not self._paused and now - since - heard_s > ABSENT_S:
            self._unheard += self._skip(round((now - since - heard_s) * SAMPLE_RATE))

    def _append(self, samples: Samples) -> None:
        fits = samples[: max(0, round(MOST_QUEUED_S * SAMPLE_RATE) - self._queued)]
        self._refused += samples.size - fits.size
        if fits.size:
            self._queue.append(fits)
            self._queued += fits.size

    def _finish(self) -> None:
        """Put what the resampler holds back into the queue; what is played next begins anew."""
        self._append(self._from_agent.push(np.zeros(0, np.float32), last=True))
        self._from_agent = Resampler(*self._from_agent.rates)

    def _take(self, count: int) -> Samples:
        parts = []
        while count and self._queue:
            part = self._queue.popleft()
            if part.size > count:
                self._queue.appendleft(part[count:])
                part = part[:count]
            parts.append(part)
            count -= part.size
            self._queued -= part.size
        return np.concatenate(parts) if parts else np.zeros(0, np.float32)

    def _skip(self, count: int) -> int:
        return self._take(count).size


def from_pcm16(pcm: bytes | memoryview, channels: int = 1) -> Samples:
    """16-bit little-endian samples, interleaved, as one channel (n,) of +-1: their mean."""
    if len(pcm) % (2 * channels):
        raise SignalError(f"found {len(pcm)} bytes, expected whole 16-bit samples of {channels} channels")
    stereo = np.frombuffer(pcm, "<i2").reshape(-1, channels).astype(np.float32) / np.float32(FULL_SCALE)
    return stereo[:, 0].copy() if channels == 1 else stereo.mean(axis=1, dtype=np.float32)


def as_pcm16(samples: Samples, channels: int = 1) -> bytes:
    """One channel (n,) as 16-bit little-endian samples, each repeated in all channels."""
    pcm = to_pcm16(samples)[0].astype("<i2")
    return pcm.tobytes() if channels == 1 else np.repeat(pcm, channels).tobytes()
