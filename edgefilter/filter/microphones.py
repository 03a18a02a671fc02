"""Which microphones of an array can be used: silent, copied, clipped, exchanged ones and others that do not fit are left out."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.exchange import EQUAL, exchanged, order_of
from edgefilter.dsp.lag import played_in
from edgefilter.filter.echo_path import TAPS
from edgefilter.types import SAMPLE_RATE, Array, ArrayStats, Samples

GOOD_BLOCKS = 3
"""Blocks of a second without a fault, in a row, after which a microphone that was left out is used again: one with a loose contact has fewer."""
APART_DB = 12.0
"""From the median microphone's level: equal microphones of one array agree within 1 to 2 dB, one of another kind beside them
was 12 to 18 dB louder (a real robot's noise on four microphones)."""
SILENT = 1e-6
"""Power, -60 dB, below which a microphone is called silent and not soft, over the loudest one's."""
UNLIKE, LEFT = 10.0, 0.3
"""A microphone is swapped, broken or processed if more of the robot is left in it than UNLIKE times what is left in the best one, and
than LEFT of its own power."""
CLIPPED_DB, MOST_CLIPPED = -0.1, 16
"""Size from which a sample counts as clipped, dB of full scale: conversion to 16 kHz may lower a clipped peak a little; so
many, 1 ms of them in a block, are no single peak."""


class Microphones:
    """Watches the microphones of one stream; step once a hop.

    left_out: why, by number. paths: (microphones, taps) of the echo where they are calibrated, which tell exchanged channels,
    once, in the first block that is full of the robot.
    """

    def __init__(self, count: int, hop: int, paths: Samples | None = None) -> None:
        self.count = count
        self.left_out: dict[int, str] = {}
        self._paths = None if paths is None else paths[:, : TAPS[0]]  # of the direct sound and the early reflections
        self._exchanged: dict[int, str] = {}
        self._played: set[int] = set()
        self._asked: set[int] = set()
        self._hops = round(SAMPLE_RATE / hop)
        self._good = [GOOD_BLOCKS] * count
        self._block = [np.zeros((rows, self._hops * hop), np.float32) for rows in (count, 2)]
        self._begin()

    def _begin(self) -> None:
        self._moments = np.zeros((self.count, self.count))
        self._errors = np.zeros(self.count)
        self._clipped = np.zeros(self.count, int)
        self._seen, self._located = 0, True

    @property
    def first(self) -> int:
        """The one that the answer sounds like."""
        return next(at for at in range(self.count) if at not in self.left_out)

    @property
    def used(self) -> np.ndarray:
        """Which microphones are used, (count,) bool."""
        return np.array([at not in self.left_out for at in range(self.count)])

    def stats(self) -> ArrayStats:
        """Ready for JSON."""
        left_out = {str(at): why for at, why in sorted(self.left_out.items())}
        return {"microphones": self.count, "reference": self.first, "left_out": left_out}

    def step(self, mic: Samples, error: Samples, ref: Samples, aligned: Samples, located: bool) -> bool:
        """Take a hop; whether others are used from now on.

        mic, error: (count, hop) of the microphones and of what the linear stage left of them. ref, aligned: (hop,) of the
        reference as it came, and where the first microphone hears it. located: whether that is known.
        """
        at = self._seen * mic.shape[1]
        here = slice(at, at + mic.shape[1])
        self._block[0][:, here], self._block[1][0, here], self._block[1][1, here] = mic, ref, aligned
        self._moments += mic @ mic.T
        self._errors += np.einsum("ch,ch->c", error, error)
        self._clipped += np.count_nonzero(np.abs(mic) >= 10 ** (CLIPPED_DB / 20), axis=1)
        self._located &= located
        self._seen += 1
        if self._seen < self._hops:
            return False
        self._find_exchanged()
        reasons = self._reasons(self._moments.diagonal().copy())
        self._begin()
        before = set(self.left_out)
        for at in range(self.count):
            self._good[at] = 0 if at in reasons else self._good[at] + 1
            if at in reasons:
                self.left_out[at] = reasons[at]
            elif self._good[at] >= GOOD_BLOCKS:
                self.left_out.pop(at, None)
        if len(self.left_out) == self.count:
            if self._exchanged:
                self.left_out.pop(0)  # any one by itself is right
            else:  # then nothing can be told
                self.left_out.clear()
        return set(self.left_out) != before

    def _find_exchanged(self) -> None:
        """See once, from a block in which the robot was found throughout, whether each channel is the calibrated one."""
        if self._paths is None or not self._located or not self._block[1][1].any():
            return
        n = self._block[0].shape[1]
        expected = np.fft.irfft(np.fft.rfft(self._block[1][1]) * np.fft.rfft(self._paths, n), n)
        found = order_of(self._block[0], expected.astype(np.float32))
        if found is not None:
            self._paths = None
            self._exchanged = exchanged(found[0])

    def _reasons(self, power: Array) -> dict[int, str]:
        """Why microphones of that power in the latest block should be left out."""
        reasons = self._levels(power)
        if self._find_played(power, {*reasons, *self.left_out}):
            reasons = self._levels(power)
        reasons |= dict.fromkeys(self._played, "what is played, not a microphone")
        fit = [at for at in range(self.count) if at not in reasons]
        clipped = [at for at in fit if self._clipped[at] >= MOST_CLIPPED]
        reasons |= dict.fromkeys(clipped if len(clipped) < len(fit) else (), "clipped")
        for at in range(self.count):
            for other in range(at):
                differ = power[at] + power[other] - 2.0 * self._moments[at, other]
                if at not in reasons and other not in reasons and power[at] > 0.0 and differ < EQUAL * power[at]:
                    reasons[at] = f"the same as channel {other}"
        reasons |= self._exchanged
        left = {at: self._errors[at] / power[at] for at in range(self.count) if at not in reasons and power[at] > 0.0}
        least = min(left.values(), default=1.0)
        for at in left:
            if left[at] > max(UNLIKE * least, LEFT):
                told = "hears the robot otherwise than it was calibrated, or than the others: processed, or broken"
                reasons[at] = told
        return reasons

    def _find_played(self, power: Array, doubted: set[int]) -> bool:
        """Ask of those that are doubted, and then of the loudest, once each, whether they are the reference; whether one is."""
        if not doubted or not self._block[1][0].any():
            return False
        asked = [at for at in {*doubted, int(np.argmax(power))} - self._asked if power[at] > 0.0]
        found = {at for at in asked if played_in(self._block[0][at], self._block[1][0])}
        self._asked |= set(asked)
        if len(self._played | found) < self.count:
            self._played |= found
        return bool(found)

    def _levels(self, power: Array) -> dict[int, str]:
        """Which are silent or of another gain, of those that are not what is played."""
        kept = [at for at in range(self.count) if at not in self._played]
        loudest = float(power[kept].max())
        reasons = {at: "silent" for at in kept if power[at] < SILENT * loudest}
        heard = [at for at in kept if at not in reasons]
        median = float(np.median(power[heard])) if len(heard) > 2 else loudest
        apart = 10 ** (APART_DB / 10)
        for at in heard if loudest > 0.0 else ():
            if not median / apart < power[at] < apart * median:
                level_db = abs(10 * np.log10(power[at] / median))
                reasons[at] = f"{level_db:.0f} dB {'louder' if power[at] > median else 'softer'} than the others"
        return reasons
