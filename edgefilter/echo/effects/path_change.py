"""The robot or something near it moved during the recording: from then on the path is another."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.frames import block_power
from edgefilter.echo.effect import NEVER_S, Parameter, first, neutral, within
from edgefilter.echo.effects.late_reverb import ADDED, AddedResponse, beside
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.echo.wiener import fit_supported
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Samples

TAPS, EXPECTED = 3072, 1e-2
"""Of what is added, 0.2 s; and the expected square of each, re the energy of the calibrated response."""
MARGIN = 1.5
"""Seconds at either end in which no change is looked for: it looks like a path that was another all along."""


class PathChange(AddedResponse):
    """h until time_s, then h + added, faded over in duration_s around it; a time_s of 1e6 s is never."""

    name = "path_change"
    run_note = "the running filter begins with the path as it was after the change"
    title = "a changed path"
    event = True
    lead = PRE_ROLL
    parameters = (
        Parameter("time_s", "s", NEVER_S, 0.0, NEVER_S),
        Parameter("duration_s", "s", 0.01, 0.0, 10.0),
        *ADDED,
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """The new response, that of after the change."""
        return super().apply(x, values, sample_rate) if float(values["time_s"]) < NEVER_S else x.copy()

    def share(self, values: Values, size: int, sample_rate: int) -> Samples:
        return _fade(size, float(values["time_s"]), float(values["duration_s"]), sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The time by the step in the residual, the new path by least squares after it, in turn.

        Neutral where that does not hold, or would have held before: then it is another path all along.

        The moment alone is chosen on all samples, since it may fall between those that the fit may use.
        """
        x, residual, scale = beside(measurement, model)
        time, edge = _step(residual, measurement.predicted(model)[1]), int(MARGIN * SAMPLE_RATE)
        for _ in range(2):
            after = measurement.weights * (np.arange(x.size) > (time + 0.3) * SAMPLE_RATE)
            taps = fit_supported(x, residual, after, 0, np.full(TAPS, EXPECTED))
            if not taps.any():
                return neutral(self)
            change = filtered(x, taps, 0)
            explained = np.cumsum(measurement.weights * change * (2.0 * residual - change), dtype=np.float64)
            start = edge + int(np.argmin(explained[edge : max(x.size - edge, edge + 1)]))
            time = start / SAMPLE_RATE
            if explained[start] > 0.0:
                return neutral(self)
        first = max(int((time - 1.2) * SAMPLE_RATE), 0)  # outside of these seconds all fades that are tried are equal
        part = slice(first, int((time + 1.2) * SAMPLE_RATE))
        around, turned, begin = residual[part], change[part], first / SAMPLE_RATE
        errors = {}
        for length in (0.01, 0.3, 0.6, 1.0):
            for at in time + np.arange(-0.6, 0.61, 0.1):
                left = around - _fade(around.size, at - begin, length, SAMPLE_RATE) * turned
                errors[(at, length)] = float(np.dot(left, left))
        time, duration = min(errors, key=lambda found: errors[found])
        time = min(time, x.size / SAMPLE_RATE)
        return within(self, {"time_s": time, "duration_s": duration, "added": scale * taps})

    def sentence(self, values: Values) -> str:
        return f"until {first(values, 'time_s'):.2f} s the calibrated path holds, from then on another one"


def _fade(n: int, time: float, duration: float, sample_rate: int) -> Samples:
    """A fade, 0 before, 1 after, a line in between, (n,)."""
    seconds = np.arange(n, dtype=np.float32) / sample_rate
    return np.clip((seconds - time) / max(duration, 1e-4) + 0.5, 0.0, 1.0).astype(np.float32)


def _step(residual: Samples, x: Samples) -> float:
    """Seconds at which the residual, in proportion to the prediction, rises most clearly: two means of its log in steps of 0.1 s."""
    block = SAMPLE_RATE // 10
    power, drive = block_power(residual, block), block_power(x, block)
    count = power.size
    loud = drive > 10.0
    ratio = np.where(loud, np.log(np.maximum(power, 1.0) / np.where(loud, drive, 1.0)), 0.0)
    total, number = np.cumsum(ratio * loud), np.cumsum(loud)
    first = int(MARGIN * SAMPLE_RATE / block)
    best, at = -np.inf, count // 2
    for k in range(first, count - first):
        before, after = number[k - 1], number[-1] - number[k - 1]
        if min(before, after) < 5:
            continue
        rise = (total[-1] - total[k - 1]) / after - total[k - 1] / before
        score = rise * np.sqrt(before * after / (before + after))
        if score > best:
            best, at = score, k
    return at * block / SAMPLE_RATE
