"""Where a whole recording has its reference: the aligner's belief, run over the file forward and backward."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import expit

from edgefilter.alignment.delay_line import WAIT, DelayBuffer
from edgefilter.alignment.lag_search import (
    CERTAIN,
    EARLY_ODDS,
    MISSED,
    MOST_LAG_S,
    NEAR,
    REFLECTIONS,
    SAME,
    Found,
    LagSearch,
)
from edgefilter.dsp.frames import decibels, stretch
from edgefilter.dsp.lag import correlation_near, flat_cross, highest
from edgefilter.errors import SignalError
from edgefilter.types import SAMPLE_RATE, Array, Samples

REACH = round(MOST_LAG_S * SAMPLE_RATE)
"""Largest lag in samples, of either sign; a running filter follows none that is longer."""
LOOK = SAMPLE_RATE
"""Samples of the recording in one look: clocks 300 ppm apart move the lag by 5 of them meanwhile. Of 23 real recordings with an echo it
is found in all; with looks of 2 s not in two whose lag changes faster, or whose microphone is processed."""
JUMP = 0.2
"""Probability that from one look to the next the lag is another: utterances last some 5 s, and each may have its own."""
LEADS = 80
"""Largest distance in samples, 5 ms, of a path's loudest arrival from the direct sound; also of one that is the loudest now and then."""
CLEAR_DB = 0.5
"""Reverberation after its sound over what is before it, 0.5 to 8 dB in 33 real pairs, tuned on, and as much below zero where they are
swapped; where a reflection is louder than the direct sound it is the other way round, so a lag of more than LEADS samples is no sign of
swapped files, and one below -LEADS, as of recorders that are started by hand, is one unless the reverberation clearly comes after."""
LOST = 1280
"""Samples that a loopback loses in a second at most: one that does in three recordings loses 8 to 76 ms, in steps of 8."""


@dataclass(frozen=True, eq=False)
class Belief:
    """What is believed of a recording's lag, look by look.

    starts: (looks,), first sample of each look, which is a second long. lags: (looks,), the likeliest, samples by which the recording lags behind
    the reference, below zero where that is late. probability: (looks,), of these lags against all others and none at all.
    late: (looks,), probability that the reference comes after its echo, by more than the filter waits for it. beyond: (looks,),
    probability that the lag is more than is followed. evidence: natural logarithm of the odds that the recording contains the
    reference at all.
    """

    starts: Array
    lags: Array
    probability: Array
    late: Array
    beyond: Array
    evidence: float

    @property
    def certain(self) -> Array:
        """The lags, samples, whose probability is above CERTAIN to one, (k,)."""
        return self.lags[self.probability > CERTAIN / (CERTAIN + 1.0)]

    @property
    def lag(self) -> int | None:
        """The median of the certain lags, samples; None where none is."""
        return int(np.sort(self.certain)[self.certain.size // 2]) if self.certain.size else None

    @cached_property
    def steps(self) -> tuple[Array, Array, Array]:
        """By how many samples the likely lag has changed, each time that it has, and two likelihood ratios of each change, (k,) each.

        The first is that of a loopback that loses buffers, so that the lag grows; the second that of a path with several arrivals alike, of
        which now one and now another is found, so that the lag stays within LEADS of the first. Both are against a change to any lag,
        and either hypothesis leaves half of its probability to that.
        """
        likely = self.probability > 0.5
        lags, apart = self.lags[likely], np.diff(self.starts[likely])
        steps, most = np.diff(lags), LOST * np.maximum(apart / LOOK, 1.0)
        lost = 0.5 + 0.5 * REACH / most * ((steps > 0) & (steps <= most))
        arrivals = 0.5 + 0.5 * REACH / (2 * LEADS) * (np.abs(lags[1:] - lags[:1]) <= LEADS)
        changed = np.abs(steps) > SAME
        return steps[changed], lost[changed], arrivals[changed]

    @property
    def lossy(self) -> float:
        """Odds that samples are missing in the reference, divided by the prior odds (Bayes factor)."""
        _, lost, arrivals = self.steps
        return 2.0 * float(np.prod(lost)) / (1.0 + float(np.prod(arrivals)))

    @property
    def lost(self) -> int:
        """Samples that are missing in the reference, by which the lag has grown; 0 unless that is certain."""
        steps, lost, _ = self.steps
        return int(steps[lost > 0.5].sum()) if EARLY_ODDS * self.lossy > CERTAIN else 0

    @property
    def missing(self) -> str:
        """What is said of samples that are missing; nothing where none are."""
        if not self.lost:
            return ""
        ms, seconds = 1000 * self.lost / SAMPLE_RATE, (self.starts[-1] - self.starts[0]) / SAMPLE_RATE
        return (
            f"samples are missing in the reference: its echo comes later and later, by {ms:.0f} ms in {seconds:.0f} s"
        )

    def of(self, begin: int, end: int) -> Belief:
        """What the seconds say that hear half a second or more of the reference from begin to end, or all of it."""
        said = self.starts - self.lags
        there = np.minimum(said + LOOK, end) - np.maximum(said, begin) >= min(LOOK // 2, end - begin)
        starts, lags, probability = self.starts[there], self.lags[there], self.probability[there]
        return Belief(starts, lags, probability, self.late[there], self.beyond[there], self.evidence)


def believe(recording: Samples, reference: Samples) -> Belief:
    """Estimate the lag of recording (n,) behind reference (m,), between -REACH and REACH samples, second by second.

    Each second has the lag of its highest peak: the true one, with the odds of `Found`, or any lag by chance, and two such
    are the same as seldom as two lags drawn at random. From second to second the true lag stays or changes: a hidden Markov
    model whose states are the lags that were found (forward-backward algorithm, Rabiner 1989). The other hypothesis is a
    recording without the reference, all of whose lags are chance; so one word that both happen to hold is not enough.

    >>> rng = np.random.default_rng(0)
    >>> said = rng.standard_normal(96_000).astype(np.float32)
    >>> believe(np.roll(said, -200), said).lag, believe(said[::-1].copy(), said).lag
    (-200, None)
    """
    return believed(_looks(recording, reference))


def believed(looks: Sequence[Found]) -> Belief:
    """Combine successive searches into one belief, by the rule of `believe`; a running filter gives its latest searches."""
    if not looks:
        none, never = np.zeros(0, int), np.zeros(0)
        return Belief(none, none, never, never, never, 0.0)
    lags = np.array([look.lag for look in looks])
    order, state = np.argsort(lags, kind="stable"), np.zeros(lags.size, int)
    state[order[1:]] = np.cumsum(np.diff(lags[order]) > SAME)
    cells = REACH / SAME
    seen = np.full((lags.size, state.max() + 2), MISSED)  # the last state: a lag that no look has shown
    seen[np.arange(lags.size), state] += cells * np.array([look.odds / look.prior for look in looks])
    anew, late = np.ones(seen.shape[1]), np.full(seen.shape[1], EARLY_ODDS / (1.0 + EARLY_ODDS))
    anew[state], late[state] = [look.prior / cells for look in looks], lags < -WAIT
    beyond = np.zeros(seen.shape[1])
    beyond[state] = lags > REACH
    before, evidence = _after(seen, anew)
    known = before * _after(seen[::-1], anew)[0][::-1] / (seen * anew)
    known = expit(evidence) * known / known.sum(axis=1, keepdims=True)
    likely, at = known[:, :-1].argmax(axis=1), np.arange(lags.size)
    nearest = np.where(state == likely[:, None], np.abs(at - at[:, None]), lags.size).argmin(axis=1)
    starts = np.array([look.at - LOOK for look in looks])
    return Belief(starts, lags[nearest], known[at, likely], known @ late, known @ beyond, evidence)


def _after(seen: Array, anew: Array) -> tuple[Array, float]:
    """Probability (looks, states) of each state after a look and those before it, and the logarithm of all that is seen.

    seen: (looks, states), its likelihood in each state; anew: (states,), of each state at first.
    """
    believed, after, evidence = anew, np.empty_like(seen), 0.0
    for row, likelihood in zip(after, seen, strict=True):
        believed = likelihood * ((1.0 - JUMP) * believed + JUMP * anew)
        evidence += math.log(believed.sum())
        row[:] = believed = believed / believed.sum()
    return after, evidence


def find_lag(recording: Samples, reference: Samples, found: Belief | None = None) -> int:
    """Samples by which a recording (n,) lags behind the reference (m,). found: what is believed of them, if that is known.

    Raises SignalError where the recording does not contain the reference, and where the two are swapped.
    """
    found = found or believe(recording, reference)
    if found.lag is None:
        level = decibels(np.mean(np.square(reference, dtype=np.float64)))
        raise SignalError(
            f"the recording does not contain the reference (of {level:.0f} dBFS) at any lag up to {MOST_LAG_S:g} s: is it of"
            " another recording, or was the loudspeaker muted? ('edgefilter doctor' finds wrong connections)"
        )
    clear = CLEAR_DB if found.lag < -LEADS else -CLEAR_DB
    if found.lag < LEADS and _reverberation_db(recording, reference, found) < clear:
        raise SignalError(
            "recording and reference seem to be swapped: the reference has the robot's reverberation"
            f" (lag {1000 * found.lag / SAMPLE_RATE:.0f} ms): give as recording what the microphone heard; if it is, let the"
            " reference begin earlier"
        )
    return found.lag


def _reverberation_db(recording: Samples, reference: Samples, found: Belief) -> float:
    """Energy of the correlation from NEAR to REFLECTIONS samples after its peak over that before it, second by second."""
    around = np.zeros(2 * REFLECTIONS + 1)
    for start, lag, probability in zip(found.starts, found.lags, found.probability, strict=True):
        said, heard = stretch(reference, start - lag, start - lag + LOOK), stretch(recording, start, start + LOOK)
        near = correlation_near(flat_cross(said, heard, 2 * LOOK), 2 * LOOK, REFLECTIONS)
        around += probability * np.square(np.roll(near, -highest(np.abs(near))[0]))
    return float(decibels(around[REFLECTIONS + NEAR :].sum() / around[: REFLECTIONS + 1 - NEAR].sum()))


def _looks(recording: Samples, reference: Samples) -> list[Found]:
    """What looks one after the other at the recording (n,) find in the reference (m,)."""
    search = LagSearch(0, any_lag=(2 * REACH, 0, LOOK))
    mic, ref = DelayBuffer(REACH + recording.size), DelayBuffer(reference.size)
    mic.push(np.zeros(REACH, np.float32))  # a lag of -REACH is none then
    mic.push(recording)
    ref.push(reference)
    looks, heard = [], REACH
    for stop in [*range(REACH + LOOK, mic.end, LOOK), mic.end]:
        search.prepare(ref, stop)
        search.listen({0: mic}, stop, heard)
        if found := search.find():
            looks.append(replace(found, lag=found.lag - REACH, at=stop - REACH))
        heard = stop
    return looks
