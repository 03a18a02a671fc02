"""A player or a driver lost or repeated samples: the delay jumps."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.fractional_delay import delayed
from edgefilter.dsp.frames import stretch
from edgefilter.echo.effect import NEVER_S, Effect, Parameter, complete, neutral, numbers
from edgefilter.echo.effects.clock_drift import STEADY, robust_line
from edgefilter.echo.lag_track import LagTrack, lags_of
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

MOST_JUMPS = 8
"""More are another effect: a lag that moves all the time."""
FADE = 512
"""Samples on either side of a stretch between two jumps that are shifted with it, and fade out away from it."""
LEAST_JUMP = 0.3
"""Samples; less is no jump, but a block's lag that is not known better."""
OUTLIER = 25.0
"""Most that the lag of one block adds to the squared misfit, in its variances, of a course of steps or of a line: five standard deviations."""
COST = 12.0
"""What each number of a step function has to save in squared, normalised distance, per unit of log(blocks)."""
HISTORY, SETTLED, AFTERMATH = 8000, 640, 6400
"""Samples: what the path remembers of the time before a jump; what may be unsure of its moment; what shows the jump."""
SEARCH = (range(-256, 257, 32), range(-24, 25, 8), range(-6, 7, 2), (-1, 0, 1))
"""Samples by which its moment is moved, in turn, from the best so far."""


class DelayJump(Effect):
    """The reference is played later by samples[i], not always whole ones, from times_s[i] on, and by offset from the start on.

    What the player puts into the gap where the delay grows: the last samples once more (gap_gain 1) or silence (0).
    """

    name = "delay_jump"
    stage = "source"
    family = "time"
    run_note = "the running filter finds jumps by itself, and those found are of this recording only: adding them changes nothing there"
    title = "a delay jump"
    event = True
    followed = True
    complexity = 1
    parameters = (
        Parameter("times_s", "s", 0.0, 0.0, NEVER_S),
        Parameter("samples", "samples", 0.0, -48000.0, 48000.0),
        Parameter("offset", "samples", 0.0, -32000.0, 32000.0),
        Parameter("gap_gain", "", 1.0, 0.0, 1.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        times, steps = numbers(values, "times_s"), numbers(values, "samples")
        order = np.argsort(times, kind="stable")
        at = np.clip(np.round(times[order] * sample_rate), 0, x.size).astype(int)
        delays = float(values["offset"]) + np.concatenate(([0.0], np.cumsum(steps[order])))
        out = x.copy()
        for start, stop, delay in zip([0, *at], [*at, x.size], delays, strict=True):
            if delay != 0.0 and stop > start:
                out[start:stop] = _later(x, delay, start, stop)
        if float(values["gap_gain"]) != 1.0:
            for start, step in zip(at, steps[order], strict=True):
                out[start : start + int(max(step, 0.0))] *= np.float32(values["gap_gain"])
        return out

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Steps through the lags of all blocks; none where a straight line, a drift, describes the lags as well.

        How many and how high comes from the samples to fit on; where exactly each lies from all, since it may fall between these.
        """
        predicted, recording = measurement.predicted(model)[1], measurement.white_recording
        track = measurement.once(lags_of, model)
        if track.lag.size < 4:
            return neutral(self)
        edges, levels = find_steps(track.lag, np.hypot(track.sigma, STEADY))
        if not 1 <= edges.size <= MOST_JUMPS or _line_is_as_good(track, edges, levels):
            return neutral(self)
        times = [_locate(predicted, recording, track, edge, levels[i : i + 2]) for i, edge in enumerate(edges)]
        return self._refined(measurement, model, np.array(times) / SAMPLE_RATE, np.diff(levels), float(levels[0]))

    def _refined(
        self, measurement: Measurement, model: VoiceModel, times_s: Array, samples: Array, offset: float
    ) -> Values:
        """The values with each jump at the moment in the reference that predicts best around it, and the gap filled so as to."""

        def left(moments: Array, gap_gain: float, around: int) -> float:
            part = slice(max(around - HISTORY, 0), around + AFTERMATH)
            start = part.start / SAMPLE_RATE
            late = moments > start
            before = offset + float(samples[~late].sum())
            times, steps = (moments[late] - start, samples[late]) if late.any() else (0.0, 0.0)
            local = complete(self, {"times_s": times, "samples": steps, "offset": before, "gap_gain": gap_gain})
            predicted = model.predict(self.apply(measurement.reference[part], local, SAMPLE_RATE))
            rest = measurement.whiten(measurement.recording[part] - predicted)
            return float(np.sum(rest[around - SETTLED - part.start :].astype(np.float64) ** 2))

        times, found = times_s * SAMPLE_RATE, []
        for gap_gain in (1.0, 0.0) if np.any(samples > 1.0) else (1.0,):
            moved, cost = times / SAMPLE_RATE, 0.0
            for i, time in enumerate(times):
                around, at = int(time), time - PRE_ROLL
                for steps in SEARCH:
                    tries = []
                    for step in steps:
                        moved[i] = max(at + step, 0.0) / SAMPLE_RATE
                        tries.append((left(moved, gap_gain, around), at + step))
                    least, at = min(tries)
                moved[i] = max(at, 0.0) / SAMPLE_RATE
                cost += least
            found.append((cost, gap_gain, moved))
        _, gap_gain, moved = min(found, key=lambda tried: tried[0])
        return {"times_s": moved, "samples": samples, "offset": offset, "gap_gain": gap_gain}

    def sentence(self, values: Values) -> str:
        times, samples = numbers(values, "times_s"), numbers(values, "samples")
        steps = ", ".join(f"{n:+.1f} samples at {t:.2f} s" for t, n in zip(times, samples, strict=True))
        return f"the lag is constant but for steps: {steps}"


def _later(x: Samples, delay: float, start: int, stop: int) -> Samples:
    """Return delayed(x, delay)[start:stop] of x (n,), from that stretch and what is near it, (stop - start,)."""
    whole = round(delay)
    first, last = (int(np.clip(at - whole, 0, x.size)) for at in (start - FADE, stop + FADE))
    near, fade = x[first:last].copy(), np.linspace(0.0, 1.0, FADE, dtype=np.float32)
    if first > 0 and near.size >= FADE:
        near[:FADE] *= fade
    if last < x.size and near.size >= FADE:
        near[-FADE:] *= fade[::-1]
    if near.size and delay != whole:
        near = delayed(near, delay - whole)
    return stretch(near, start - whole - first, stop - whole - first)


def find_steps(lag: Array, sigma: Array) -> tuple[Array, Array]:
    """Step function through lag (b,): the first block of each new level, and the levels.

    Optimal partition by dynamic programming (Jackson et al. 2005) with a penalty per level of COST log b, levels by
    their median. Neighbouring levels closer than LEAST_JUMP are merged.
    """
    count = lag.size
    penalty = COST * np.log(count)
    if _misfit(lag, float(np.median(lag)), sigma) <= penalty:  # no step can pay for itself
        return np.zeros(0, int), np.array([_level(lag, sigma)])
    best, origin = np.full(count + 1, np.inf), np.zeros(count + 1, int)
    best[0] = -penalty
    for stop in range(1, count + 1):
        for start in range(stop):
            part = slice(start, stop)
            total = best[start] + penalty + _misfit(lag[part], float(np.median(lag[part])), sigma[part])
            if total < best[stop]:
                best[stop], origin[stop] = total, start
    cuts = [count]
    while cuts[-1] > 0:
        cuts.append(origin[cuts[-1]])
    cuts = cuts[::-1]
    while True:
        levels = np.array([_level(lag[a:b], sigma[a:b]) for a, b in zip(cuts[:-1], cuts[1:], strict=True)])
        small = np.flatnonzero(np.abs(np.diff(levels)) < LEAST_JUMP)
        if not small.size:
            return np.array(cuts[1:-1], int), levels
        del cuts[small[0] + 1]


def _misfit(lag: Array, level: Array | float, sigma: Array) -> float:
    return float(np.minimum(((lag - level) / sigma) ** 2, OUTLIER).sum())


def _level(lag: Array, sigma: Array) -> float:
    """Weighted mean of the lags near their median."""
    middle = float(np.median(lag))
    near = np.abs(lag - middle) < np.maximum(4 * sigma, 0.5)
    return float(np.average(lag[near], weights=1 / sigma[near] ** 2)) if near.any() else middle


def _line_is_as_good(track: LagTrack, edges: Array, levels: Array) -> bool:
    sigma = np.hypot(track.sigma, STEADY)
    slope, offset = robust_line(track.middle, track.lag, track.sigma)
    line = _misfit(track.lag, slope * track.middle + offset, sigma)
    steps = _misfit(track.lag, levels[np.searchsorted(edges, np.arange(track.lag.size), side="right")], sigma)
    return line <= steps + COST * np.log(track.lag.size) * edges.size


def _locate(predicted: Samples, recording: Samples, track: LagTrack, edge: int, levels: Array) -> int:
    """The sample from which on the second delay predicts better than the first, between the blocks before and after."""
    start = int(track.starts[edge - 1])
    stop = int(track.starts[edge]) + track.size
    margin = int(np.abs(levels).max()) + 64
    low = max(start - margin, 0)
    around = predicted[low : stop + margin]
    part = slice(start - low, stop - low)
    before, after = ((recording[start:stop] - delayed(around, level)[part]) ** 2 for level in levels)
    return start + int(np.argmin(np.concatenate(([0.0], np.cumsum((before - after).astype(np.float64))))))
