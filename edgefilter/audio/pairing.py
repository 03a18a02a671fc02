"""Two devices, two clocks, one sample counter: what a microphone and a reference delivered, as blocks."""

from __future__ import annotations

from collections import deque

import numpy as np

from edgefilter.dsp.ring import Ring
from edgefilter.types import SAMPLE_RATE, Block, Samples

MAX_WAIT = SAMPLE_RATE // 4
"""Samples for which the microphone waits for a reference that is late, before silence stands in for it."""
TOLERANCE = SAMPLE_RATE // 50
"""Samples by which the two counters may differ for good: one callback of 20 ms, which come in any phase."""
BUFFER_S = 2.0
"""How much sound a ring holds while the filter is busy; beyond it samples are lost, and counted. A device that delivers
nothing for as long has stopped."""
WINDOW = round(BUFFER_S * SAMPLE_RATE)
"""Samples: a difference counts as lasting when it was never smaller for so long; a busy machine catches up sooner."""


class Inlet:
    """A ring that an audio callback fills, with the places where it had to leave samples out.

    The callback calls `receive`; the reader calls `take`, which puts silence where samples are missing, so that
    the sample counter stays true. channels: samples are then (n, channels) in place of (n,). lost: samples that did not
    fit. flags: callbacks that the driver marked as overrun.
    """

    def __init__(self, capacity: int, channels: int | None = None) -> None:
        self._ring = Ring(capacity, channels)
        self._gaps: deque[tuple[int, int]] = deque()
        self._stored = 0
        self._read = 0
        self.flags = 0

    @property
    def lost(self) -> int:
        return self._ring.lost

    @property
    def received(self) -> int:
        """Samples that the device delivered so far, lost ones included."""
        return self._stored + self._ring.lost

    def receive(self, samples: Samples, flagged: bool = False) -> None:
        """Called by the audio thread with (n,) samples."""
        count = self._ring.write(samples)
        self._stored += count
        if count < len(samples):
            self._gaps.append((self._stored, len(samples) - count))
        self.flags += flagged

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
    """Pairs microphone and reference samples; every sample of the microphone, whose counter is the master, comes out.

    It waits for its reference. After MAX_WAIT samples silence stands in (`filled`), and what arrives late for those
    places is discarded, so that a stall does not shift the reference. If the counters differ by more than TOLERANCE
    throughout WINDOW, the clocks differ or a driver lost samples: the reference is cut (`dropped`) or extended with
    silence (`inserted`) to meet the counter again. late_is_lost: False where the reference is what is played here:
    after a stall it is not late but played later, so that nothing of it is discarded.
    """

    def __init__(self, late_is_lost: bool = True, microphones: int = 1) -> None:
        self._late_is_lost = late_is_lost
        self._mic = np.zeros(0 if microphones == 1 else (0, microphones), np.float32)
        self._ref = np.zeros(0, np.float32)
        self._debt = 0
        self._next = 0
        self._smallest: int | None = None
        self._watched = 0
        self.filled = self.dropped = self.inserted = 0

    def push(self, mic: Samples, ref: Samples, silence: int = 0) -> Block | None:
        """Take what arrived, (n,), or (n, channels) of an array, and (m,), and return the block that is complete, if any.

        silence: so many of ref, the first ones, stand in for a device that is away; the caller counts them.
        """
        late = min(self._debt, ref.size)
        self._debt -= late
        self.filled -= min(late, silence)
        self._mic = np.concatenate((self._mic, mic))
        self._ref = np.concatenate((self._ref, ref[late:]))
        lost = self.filled + self.dropped + self.inserted
        self._watch(len(mic))
        missing = len(self._mic) - self._ref.size - MAX_WAIT
        if missing > 0:
            self._debt += missing * self._late_is_lost
            self.filled += self._extend(missing)
        return self._emit(min(len(self._mic), self._ref.size), self.filled + self.dropped + self.inserted - lost)

    def flush(self) -> Block | None:
        """The microphone samples still waiting; silence stands in for their reference."""
        missing = self._extend(max(0, len(self._mic) - self._ref.size))
        self.filled += missing
        return self._emit(len(self._mic), missing)

    def _extend(self, count: int) -> int:
        """Put so much silence behind the reference."""
        self._ref = np.concatenate((self._ref, np.zeros(count, np.float32)))
        return count

    def _emit(self, count: int, lost: int) -> Block | None:
        if count == 0:
            return None
        block = Block(self._mic[:count], self._ref[:count], self._next, lost)
        self._mic, self._ref = self._mic[count:], self._ref[count:]
        self._next += count
        return block

    def _watch(self, arrived: int) -> None:
        """Follow the smallest difference of the counters (reference ahead: positive), and act on one that lasts."""
        skew = self._ref.size - len(self._mic) - self._debt
        before = self._smallest
        if before is None or abs(skew) < abs(before) or (skew > 0) != (before > 0):
            self._smallest = skew if before is None or (skew > 0) == (before > 0) else 0
        self._watched += arrived
        if self._watched < WINDOW:
            return
        lasting, self._smallest, self._watched = self._smallest or 0, None, 0
        if lasting > TOLERANCE:
            self._ref = self._ref[lasting:]
            self.dropped += lasting
        elif lasting < -TOLERANCE:
            forgiven = min(self._debt, -lasting)
            self._debt -= forgiven
            self.inserted += self._extend(-lasting - forgiven)


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
        """Called by the audio thread to fill out (n,)."""
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
