"""A microphone and its reference on one sample counter, and the rings between them and the audio callbacks."""

from __future__ import annotations

from collections import deque

import numpy as np

from edgefilter.dsp.ring import Ring
from edgefilter.types import SAMPLE_RATE, Samples

MAX_WAIT = SAMPLE_RATE // 4
"""Samples for which the microphone waits for a reference that is late, before silence stands in for it."""
TOLERANCE = SAMPLE_RATE // 50
"""Samples by which the counters of two devices may drift apart before they meet again: one callback of 20 ms."""
BUFFER_S = 2.0
"""How much sound a ring holds while the filter is busy; beyond it samples are lost, and counted. A device that delivers
nothing for as long has stopped. As much of the reference is kept to be used again where sound that seemed lost comes after all."""


class Inlet:
    """A ring that an audio callback fills, with the places where it had to leave samples out.

    The callback calls `receive`; the reader calls `take`, which puts silence where samples are missing, so that
    the sample counter stays true. channels: samples are then (n, channels) in place of (n,). lost: samples that did not
    fit. flags: callbacks that the driver marked as overrun. latest: what was received when samples last came, and that time, s.
    """

    def __init__(self, capacity: int, channels: int | None = None) -> None:
        self._ring = Ring(capacity, channels)
        self._gaps: deque[tuple[int, int]] = deque()
        self._stored = 0
        self._read = 0
        self.flags = 0
        self.latest = (0, 0.0)

    @property
    def lost(self) -> int:
        return self._ring.lost

    @property
    def received(self) -> int:
        """Samples that the device delivered so far, lost ones included."""
        return self.latest[0]

    def receive(self, samples: Samples, flagged: bool = False, at: float = 0.0) -> None:
        """Called by the audio thread with (n,) samples, at this time."""
        count = self._ring.write(samples)
        self._stored += count
        if count < len(samples):
            self._gaps.append((self._stored, len(samples) - count))
        self.flags += flagged
        self.latest = (self.latest[0] + len(samples), at)

    def take(self) -> Samples:
        """Everything that arrived since the last call, (n,) float32, gaps filled with silence."""
        upto = self._stored
        parts = []
        while self._gaps and self._gaps[0][0] <= upto:
            at, missing = self._gaps.popleft()
            there = self._ring.read(at - self._read)
            parts += [there, np.zeros((missing, *there.shape[1:]), np.float32)]
            self._read = at
        parts.append(self._ring.read(upto - self._read))
        self._read = upto
        return np.concatenate(parts)


class Pairing:
    """Pairs each sample of the microphone, whose counter is the master clock, with one of the reference.

    Both wait here until they are paired. late_is_lost: whether reference that comes after silence has stood in for it is
    discarded, so that the rest is not shifted; otherwise it is used later. Counters, in samples: queued: of the reference, waiting;
    played: of the reference, paired; filled: silence in place of reference that had not come in time; inserted: silence in place of
    reference that will never come; skipped: of the reference, left out because the microphone lost as many; dropped: of the
    reference, removed because it will not be played.
    """

    def __init__(self, late_is_lost: bool = True) -> None:
        self._late_is_lost = late_is_lost
        self.mic, self._ref = np.zeros(0, np.float32), np.zeros(0, np.float32)
        self._came: list[Samples] = []
        self._at = self._debt = self.queued = 0
        self.played = self.filled = self.inserted = self.skipped = self.dropped = 0

    @property
    def known(self) -> int:
        """Samples of the microphone whose reference is there, or is known to be lost."""
        return max(self.queued - self._debt, 0)

    def hear(self, mic: Samples) -> None:
        """Take what the microphone brings next, (n,), or (n, channels) of an array."""
        self.mic = np.concatenate((self.mic, mic)) if len(self.mic) else mic.copy()

    def play(self, ref: Samples, silence: int = 0) -> None:
        """Take the reference that follows, (n,); the first `silence` samples, which the caller counts, stand in for a device."""
        if ref.size:
            self._came.append(ref.copy())
        self.queued += ref.size
        self.filled -= min(self.move(0).size, silence)

    def pair(self, count: int) -> tuple[Samples, Samples]:
        """The first count samples of the microphone, and their reference, (n,), with silence where that lacks."""
        mic, self.mic = self.mic[:count], self.mic[count:]
        inserted = min(max(-self._debt, 0), count)
        ref = self._take(count - inserted if self._debt <= 0 else 0)
        filled = count - inserted - ref.size
        self.played, self.filled, self.inserted = self.played + ref.size, self.filled + filled, self.inserted + inserted
        self._debt += inserted + filled * self._late_is_lost
        return mic, np.concatenate((np.zeros(inserted, np.float32), ref, np.zeros(filled, np.float32)))

    def skip(self, count: int) -> Samples:
        """Go on by what was played, (n,), while the microphone lost so many samples; empty until all of it is there."""
        self.skipped += count
        return self.move(count)

    def put_back(self, count: int) -> None:
        """Go back by so many samples of those skipped: what they are to be paired with was late, not lost."""
        count = min(count, self.skipped, self._at)
        self._at, self.queued, self.skipped = self._at - count, self.queued + count, self.skipped - count

    def drop(self, count: int) -> None:
        """Remove so many samples from the front of the queued reference: they will never be played."""
        self.dropped += self._take(count).size
        self._ref, self._at = self._ref[self._at :], 0

    def move(self, by: int) -> Samples:
        """Skip so many samples of the reference and return them, (n,), once all of them have come, till then (0,); by < 0: insert so much silence."""
        self._debt += by
        late = self._take(self._debt if 0 < self._debt <= self.queued else 0)
        self._debt -= late.size
        return late

    def _take(self, count: int) -> Samples:
        if count > self._ref.size - self._at:
            kept = min(self._at, round(BUFFER_S * SAMPLE_RATE))
            self._ref, self._came = np.concatenate((self._ref[self._at - kept :], *self._came)), []
            self._at = kept
        taken = self._ref[self._at : self._at + count]
        self._at, self.queued = self._at + taken.size, self.queued - taken.size
        return taken


class Outlet:
    """A ring that an audio callback empties; it starts, and starts again after an underrun, once `margin` samples wait.

    underruns: callbacks that found too little; missing: samples of silence that they played instead. draining: nothing
    follows, so that silence is no underrun.
    """

    def __init__(self, capacity: int, margin: int) -> None:
        self.ring = Ring(capacity)
        self._margin = margin
        self._waiting = True
        self.draining = self._started = False
        self.underruns = self.missing = self.calls = 0

    def deliver(self, out: Samples) -> None:
        """Write the next samples into `out` (n,); the audio thread calls it."""
        self.calls += 1
        if self._waiting and (len(self.ring) >= self._margin or self.draining):
            self._waiting, self._started = False, True
        data = out[:0] if self._waiting else self.ring.read(out.size)
        out[: data.size] = data
        out[data.size :] = 0.0
        if data.size < out.size and self._started and not self.draining:
            self.underruns += not self._waiting
            self.missing += out.size - data.size
            self._waiting = True
