"""How much of the robot the linear stage takes off now, and whether it could take off more."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from edgefilter.dsp.fourier import LEAST
from edgefilter.filter.canceller import CancellerOutput
from edgefilter.filter.volume import AUDIBLE, FORGET_S, PRE_EMPHASIS, pre_emphasised
from edgefilter.types import SAMPLE_RATE, Samples

BLOCK, BLOCKS, ENOUGH = 16, 20, 12
"""Hops with audible echo in a block, 0.25 s; blocks that are kept, 5 s; blocks that a figure needs at least, 3 s."""
SETTLED = 0.3
"""Expected power of the misalignment over that of the error, -5 dB, below which the filter has learned what it can: far-end
blocks of 18 real devices that the filter went on improving by more than 3 dB had more, but for 1 in 20."""
LITTLE_DB = 3.0
"""Echo reduction, dB, below which the robot's echo counts as unpredicted. Tuned on 27 real recordings: with an intact loopback the
reduction stays at 4 dB or more, but for the processed microphone gf_0sKU1J (2.6 dB at first, later 0.8)."""
MUCH_DB = 6.0
"""ERLE, dB. Where it was reached once, the echo is linear in the reference, and a lower ERLE later has another cause. Without this rule
one of 27 recordings, gf_655836, would get a wrong message."""
FOLLOWS = 0.4
"""Correlation of the log powers of error and reference from which on what is left is the robot: 0.5 to 0.6 on that
microphone; where a human talks all the time -0.1 to 0.3."""


class Removal:
    """Compares the powers of microphone and error while the robot is heard, both pre-emphasised.

    hop: samples per step. unpredicted: whether the robot is heard, the filter has learned what it can, and hardly anything
    of the robot is removed.
    """

    def __init__(self, hop: int) -> None:
        self._forget = 0.1 ** (hop / (FORGET_S * SAMPLE_RATE))
        turn = np.exp(-1j * np.pi * np.arange(hop + 1) / hop)
        self._emphasis = (np.square(np.abs(1.0 - PRE_EMPHASIS * turn)) / hop).astype(np.float32)
        self._peak = 0.0
        self._block, self._hops = np.zeros(4), 0
        self._blocks: deque[np.ndarray] = deque(maxlen=BLOCKS)
        self._levels: deque[tuple[float, float]] = deque(maxlen=BLOCK * BLOCKS)
        self._most_db = 0.0
        self.unpredicted = False

    def step(self, mic: Samples, reference: Samples, found: CancellerOutput) -> None:
        """Take one hop (hop,) of the microphone and of the delay-aligned reference, with the linear stage's output for it."""
        emphasised = pre_emphasised(np.array((mic, found.error, reference, found.innovation)))
        heard, left, played, innovation = np.einsum("ij,ij->i", emphasised, emphasised).tolist()
        self._peak = max(played, self._forget * self._peak)
        if not self._peak:
            return
        least = LEAST * self._peak
        self._levels.append((math.log(left + least), math.log(played + least)))
        if played <= AUDIBLE * self._peak:
            return
        self._block += heard, left, float(found.uncertainty @ self._emphasis), innovation
        self._hops += 1
        if self._hops == BLOCK:
            self._blocks.append(self._block)
            self._block, self._hops = np.zeros(4), 0
            self.unpredicted = self._judge()

    @property
    def removed_db(self) -> float | None:
        """Echo return loss enhancement, dB, over that half of the last 5 s of robot speech in which it is higher; None before 3 s.

        The other half may hold a human, which the filter rightly leaves.
        """
        if len(self._blocks) < ENOUGH:
            return None
        heard, left = np.array(self._blocks)[:, :2].T + 1e-30
        better = heard / left >= np.median(heard / left)
        return -10.0 * math.log10(max(left[better].sum() / heard[better].sum(), LEAST))

    def _judge(self) -> bool:
        removed = self.removed_db
        self._most_db = max(self._most_db, removed or 0.0)
        if removed is None or removed >= LITTLE_DB or self._most_db >= MUCH_DB:
            return False
        settled = sum(misaligned < SETTLED * error for _, _, misaligned, error in self._blocks)
        return settled >= ENOUGH and float(np.corrcoef(np.array(self._levels).T)[0, 1]) > FOLLOWS
