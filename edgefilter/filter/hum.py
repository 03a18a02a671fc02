"""Hum of the mains, taken off the microphone where it is most of what is heard."""

from __future__ import annotations

import numpy as np

from edgefilter.types import SAMPLE_RATE, Array, Samples

TONES_HZ = (50.0, 100.0, 150.0, 200.0, 60.0, 120.0, 180.0, 240.0)
"""The mains of all countries, and what rectifiers and transformers make of them."""
NOTCH_HZ, FAINTEST = 2.0, 0.01
"""Width of the notch at a tone, Hz: it is in place half a second later. FAINTEST: power of a tone that is taken off, relative to
the loudest."""


class Hum:
    """Takes the tones of the mains off a signal, hop by hop, once they were more than half of its power for half a second.

    Least mean squares with a cosine and a sine of each tone (Widrow et al. 1975, "Adaptive noise cancelling"). known:
    whether they were; until then the signal stays as it is.
    """

    def __init__(self, hop: int) -> None:
        self._hop, self._second = hop, SAMPLE_RATE // hop
        self._rate = np.float32(2.0 * np.pi * NOTCH_HZ / SAMPLE_RATE)
        self._tones = self._before = np.zeros(len(TONES_HZ), np.complex64)
        self._hops, self._more, self.known = 0, 0.0, False
        self._tune(np.array(TONES_HZ))

    def step(self, x: Samples) -> Samples:
        """Filter the next hop x (..., hop): return it without hum once hum has been found, unchanged before."""
        left = x - (self._tones @ self._waves).real
        self._tones = (self._tones + self._rate * (left @ self._waves.conj().T)) * self._hop_turn
        if self.known:
            return left
        self._hops = (self._hops + 1) % self._second
        if self._hops <= self._second // 2:  # the notch still settles, so what it takes off is not measured yet
            self._before = self._tones
        else:
            self._more += float(np.vdot(x, x)) - 2.0 * float(np.vdot(left, left))
        if self._hops == self._second - 1:
            self.known, self._more = self._more > 0.0, 0.0
            if self.known:
                self._find()
        return x

    def _find(self) -> None:
        """Keep the tones that are there, at their true frequency: it turns them on against the nominal one."""
        hops = self._hops - self._second // 2
        turned = np.sum((self._tones * np.conj(self._before * self._hop_turn**hops)).reshape(-1, len(TONES_HZ)), axis=0)
        self._tune(np.array(TONES_HZ) + np.angle(turned) / (2.0 * np.pi * hops * self._hop / SAMPLE_RATE))
        self._waves[np.abs(turned) < FAINTEST * np.abs(turned).max()] = 0.0

    def _tune(self, hz: Array) -> None:
        turns = 2j * np.pi * hz / SAMPLE_RATE
        self._waves = np.exp(turns[:, None] * np.arange(self._hop)).astype(np.complex64)
        self._hop_turn = np.exp(turns * self._hop).astype(np.complex64)
