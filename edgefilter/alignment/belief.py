"""Where a whole recording has its reference: the aligner's belief, run over the file forward and backward."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from edgefilter.alignment.aligner import MOST_LAG_S, UNSEEN
from edgefilter.alignment.delay_line import Tape
from edgefilter.alignment.lag_search import CERTAIN, Found, LagSearch
from edgefilter.dsp.frames import decibels
from edgefilter.errors import SignalError
from edgefilter.types import SAMPLE_RATE, Array, Samples

LOOK = SAMPLE_RATE
"""Samples of the recording in one look: clocks 300 ppm apart move the lag by 5 of them meanwhile. Of 23 real recordings with an echo it
is found in all; with looks of 2 s not in two whose lag changes faster, or whose microphone is processed."""
SAME = 32
"""Samples by which the lags of two looks may differ and be one lag: what clocks and a person who walks move it by."""
JUMP = 0.2
"""Probability that from one look to the next the lag is another, or none: utterances last some 5 s, and each may have its own."""


@dataclass(frozen=True, eq=False)
class Belief:
    """What is believed of a recording's lag, look by look.

    lags: (looks,), the likeliest, samples by which the recording lags behind the reference, below zero where that is late.
    probability: (looks,), of these lags against all others and none.
    """

    lags: Array
    probability: Array

    @property
    def certain(self) -> Array:
        """The lags that are certain, (k,)."""
        return self.lags[self.probability > CERTAIN / (CERTAIN + 1.0)]

    @property
    def lag(self) -> int | None:
        """The median of the certain lags, samples; None where none is."""
        return int(np.sort(self.certain)[self.certain.size // 2]) if self.certain.size else None


def believe(recording: Samples, reference: Samples, reach: int = round(MOST_LAG_S * SAMPLE_RATE)) -> Belief:
    """What is to be believed of the lag of recording (n,) behind reference (m,), between -reach and reach samples.

    Each look either finds the reference where it is, with the odds of `Found`, or it finds chance, which agrees with another look
    as often as two of all lags are the same. Between looks a lag stays or changes: a hidden Markov model whose states
    are the lags that were found, and none (forward-backward algorithm, Rabiner 1989).

    >>> rng = np.random.default_rng(0)
    >>> said = rng.standard_normal(96_000).astype(np.float32)
    >>> believe(np.roll(said, -200), said).lag, believe(said[::-1].copy(), said).lag
    (-200, None)
    """
    looks = _looks(recording, reference, reach)
    if not looks:
        return Belief(np.zeros(0, int), np.zeros(0))
    lags = np.array([look.lag for look in looks])
    order, state = np.argsort(lags, kind="stable"), np.zeros(lags.size, int)
    state[order[1:]] = np.cumsum(np.diff(lags[order]) > SAME)
    cells = max(reach / SAME, 1.0)
    seen = np.full((lags.size, state.max() + 2), math.exp(-UNSEEN))
    seen[:, -1] = 1.0  # nowhere
    seen[np.arange(lags.size), state] = cells * np.array([look.odds / look.prior for look in looks])
    anew = np.full(seen.shape[1], 0.5)
    anew[state] = [0.5 / cells * look.prior for look in looks]
    known = _after(seen, anew) * _after(seen[::-1], anew)[::-1] / (seen * anew)
    known = (known / known.sum(axis=1, keepdims=True))[:, :-1]
    likely, at = known.argmax(axis=1), np.arange(lags.size)
    nearest = np.where(state == likely[:, None], np.abs(at - at[:, None]), lags.size).argmin(axis=1)
    return Belief(lags[nearest], known[at, likely])


def find_lag(recording: Samples, reference: Samples) -> int:
    """Samples by which a recording (n,) lags behind the reference (m,); raises SignalError where it does not contain it."""
    lag = believe(recording, reference).lag
    if lag is None:
        raise absent(reference)
    return lag


def absent(reference: Samples) -> SignalError:
    """What to say where a recording does not contain the reference (m,)."""
    level = decibels(np.mean(np.square(reference, dtype=np.float64)))
    return SignalError(
        f"the recording does not contain the reference (of {level:.0f} dBFS) at any lag up to {MOST_LAG_S:g} s: is it of another"
        " recording, or was the loudspeaker muted? ('edgefilter doctor' finds wrong connections)"
    )


def _after(seen: Array, anew: Array) -> Array:
    """Probability (looks, states) of each state after a look and those before it. seen: its likelihood there, anew: (states,), at first."""
    believed, after = anew, np.empty_like(seen)
    for row, likelihood in zip(after, seen, strict=True):
        believed = likelihood * ((1.0 - JUMP) * believed + JUMP * anew)
        row[:] = believed = believed / believed.sum()
    return after


def _looks(recording: Samples, reference: Samples, reach: int) -> list[Found]:
    """What looks one after the other at the recording (n,) find in the reference (m,)."""
    search, mic, ref = LagSearch(2 * reach, window=LOOK), Tape(reach + recording.size), Tape(reference.size)
    mic.push(np.zeros(reach, np.float32))  # a lag of -reach is none then
    mic.push(recording)
    ref.push(reference)
    looks, heard = [], reach
    for stop in [*range(reach + LOOK, mic.end, LOOK), mic.end]:
        search.prepare(ref, stop, stop - search.span)
        search.listen({0: mic}, stop, heard)
        if found := search.find():
            looks.append(replace(found, lag=found.lag - reach))
        heard = stop
    return looks
