"""The reference is streamed to the loudspeaker in packets, and some were lost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.frames import block_power, frames
from edgefilter.dsp.psd import total_power
from edgefilter.echo.effect import NEVER_S, Effect, Parameter, first, neutral, numbers, within
from edgefilter.echo.measurement import Measurement, Values, VoiceModel, whiten
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

STEP = 40
"""Samples (2.5 ms) of the finest grid on which frames are looked for."""
LENGTHS = (4, 8, 12, 16, 24)
"""Steps of a frame: 10, 20, 30, 40, 60 ms, those of RTP's audio formats (RFC 3551, 6716)."""
TAPS = 640
"""Samples of the path from the direct sound on by which a missing frame is recognised."""
BLOCK = STEP * min(LENGTHS)
"""Samples of the shortest frame."""
LOUD, MISSING, PREDICTED = 30.0, 0.5, 0.1
"""Ratios of power. A block counts where the voice is LOUD times the fan. It is missing where the residual is more than MISSING of
the voice predicted there. That is only asked where in half of the blocks the residual is less than PREDICTED of it."""
CLEAR, SURE = 100.0, 25.0
"""Energy of a frame over the variance of the residual where it says something, and by which it must fall without the frame."""
FEWEST, OFF_GRID = 4, 0.9
"""Times that frames must be lost, and what a grid half a frame off may explain at most of what the found one does. What a codec
takes away, or a compressor, keeps to no grid."""
DROPPED = 0.3
"""Of the fan's variance that must be there where a frame is missing: what the microphone itself lost has none."""
FILLS, FADES_MS = np.linspace(0.0, 1.0, 11), (0.0, 1.0, 2.0, 4.0)
FINE = (np.arange(-32, 33, 8), np.arange(-6, 7, 2), np.array([-1, 0, 1]))
"""Values that are tried; FINE: samples by which the grid is moved, in turn, from the best so far."""


class PacketLoss(Effect):
    """x = fill * x(t - length) in the frames that begin at times_s[i] and last length_ms: silence (0) to the last one repeated (1).

    The clock goes on, other than with delay_jump. A frame that follows a lost one and is lost itself repeats what was put
    into that, so that it fades. fade_ms: of the line by which one passes into the other, at both ends inside of the frame.
    """

    name = "packet_loss"
    stage = "source"
    family = "modulation"
    run_note = (
        "these packets were lost in this recording, and no others will be the same: adding it changes nothing in the"
        " running filter"
    )
    title = "lost packets"
    event = True
    complexity = 2
    parameters = (
        Parameter("times_s", "s", NEVER_S, 0.0, NEVER_S),
        Parameter("length_ms", "ms", 20.0, 1.0, 200.0),
        Parameter("fill", "", 0.0, 0.0, 1.0),
        Parameter("fade_ms", "ms", 0.0, 0.0, 5.0),
        Parameter("lost", "packets", 0.0, 0.0, 1e6),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        out = x.copy()
        length, fade = (round(float(values[name]) * 1e-3 * sample_rate) for name in ("length_ms", "fade_ms"))
        edge = np.clip((np.arange(length) + 0.5) / max(fade, 1e-9), 0.0, 1.0)
        lost = np.minimum(edge, edge[::-1]).astype(np.float32)
        for time in np.sort(numbers(values, "times_s")):
            at = round(time * sample_rate)
            part = out[at : at + length] if at < x.size else out[:0]
            before = np.zeros(part.size, np.float32)
            if at >= length:
                before = np.float32(values["fill"]) * out[at - length : at - length + part.size]
            part += lost[: part.size] * (before - part)
        return out

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The frames whose removal from the prediction lowers the error most, without overlap: their times to a sample, and what fills the gaps.

        Neutral where the fan is missing in the gaps as well: then the microphone has lost the frames, not the loudspeaker.
        """
        psd, steps = measurement.noise_psd, _steps(measurement, model)
        grid = None if steps is None else _best_grid(steps)
        if psd is None or grid is None:
            return neutral(self)
        length, start, lost = grid
        times = (start + np.flatnonzero(lost) * length) * STEP / SAMPLE_RATE
        found = {"length_ms": 1e3 * length * STEP / SAMPLE_RATE, "fill": 0.0, "fade_ms": 0.0}

        def best(name: str, tried: Iterable[float | Array]) -> Any:
            """Of the values tried that of the least error."""

            def error(value: float | Array) -> float:
                played = self.apply(measurement.reference, {**found, "times_s": times, name: value}, SAMPLE_RATE)
                left = measurement.white_recording - measurement.heard(model, played)
                return float(np.sum(left**2, dtype=np.float64))

            return min(tried, key=error)

        for moves in FINE:
            times = best("times_s", [np.maximum(times + move / SAMPLE_RATE, 0.0) for move in moves])
        for name, tried in (("fill", FILLS), ("fade_ms", FADES_MS), ("fill", FILLS)):
            found[name] = float(best(name, tried))
        size = length * STEP
        starts = np.round(times * SAMPLE_RATE).astype(int) + PRE_ROLL + size // 4
        power = [np.mean(np.square(part)) for at in starts if (part := measurement.recording[at : at + size // 2]).size]
        if np.median(power) <= DROPPED * total_power(psd):
            return neutral(self)
        return within(self, {**found, "times_s": times, "lost": times.size})

    def sentence(self, values: Values) -> str:
        times = np.sort(numbers(values, "times_s"))
        listed = ", ".join(f"{time:.2f}" for time in times[:4]) + (" s" if times.size <= 4 else " s, ...")
        fill = first(values, "fill")
        gap = "nothing" if fill < 0.1 else f"the one before, times {fill:.1f},"
        return (
            f"{times.size} frames of {first(values, 'length_ms'):.0f} ms, all on one grid, are missing from the voice, and"
            f" {gap} was played instead: at {listed}"
        )


@dataclass(frozen=True, eq=False)
class Steps:
    """Least squares for the change of the voice's gain in each STEP of the reference.

    normal: (lags, steps) diagonals of the equations. right: (steps,) their right side. noise: variance of the residual, whitened.
    """

    normal: Array
    right: Array
    noise: float


def _steps(measurement: Measurement, model: VoiceModel) -> Steps | None:
    """The equations; None where the voice is not predicted, or no block of it is missing."""
    psd, heard = measurement.noise_psd, measurement.predicted(model)[1]
    if psd is None or heard.size < 8 * TAPS:
        return None
    left = measurement.white_recording - heard
    voice, rest = block_power(heard, BLOCK), block_power(left, BLOCK)
    loud = voice > LOUD
    share = rest[loud] / voice[loud]
    if np.count_nonzero(share > MISSING) < FEWEST or np.median(share) > PREDICTED:
        return None
    rings = psd.size - 1  # the whitening, on either side
    path = whiten(np.pad(model.impulse_response, (PRE_ROLL, rings)), psd)[: TAPS + PRE_ROLL]
    count, size = heard.size // STEP, STEP + path.size - 1
    pieces = measurement.reference[: count * STEP].reshape(count, STEP)
    driven = scipy.signal.fftconvolve(pieces, path[None], axes=1).astype(np.float32)
    around = frames(np.pad(left, (PRE_ROLL, size)), size, STEP)[:count]
    lags = -(-size // STEP)
    normal = np.zeros((lags, count))
    for lag in range(lags):
        own, later = driven[: count - lag, lag * STEP :], driven[lag:, : size - lag * STEP]
        normal[lag, : count - lag] = np.einsum("ij,ij->i", own, later)
    noise = max(1.0, float(np.median(rest[loud])))
    return Steps(normal, np.einsum("ij,ij->i", driven, around), noise)


def _best_grid(steps: Steps) -> tuple[int, int, NDArray[np.bool_]] | None:
    """Steps of a frame, the first one's step, and which were lost, (frames,), of the grid that explains most; None for no packets."""
    tried = {(length, first): _without(steps, length, first) for length in LENGTHS for first in range(length)}
    length, first = max(tried, key=lambda grid: tried[grid][0])
    worth, sure, clear = tried[length, first]
    lost = sure & clear
    beside = max(tried[length, (first + shift) % length][0] for shift in range(length // 4, length - length // 4 + 1))
    if np.count_nonzero(lost & ~np.roll(lost, 1)) < FEWEST or beside > OFF_GRID * worth:
        return None
    return length, first, sure


def _without(steps: Steps, length: int, first: int) -> tuple[float, NDArray[np.bool_], NDArray[np.bool_]]:
    """What the lost frames of a grid explain, less the cost of saying which; of each whether surely lost, whether loud enough."""
    count = (steps.right.size - first) // length
    part = slice(first, first + count * length)
    right = steps.right[part].reshape(count, length).sum(axis=1)
    energy = steps.normal[0, part].reshape(count, length).sum(axis=1)
    for lag in range(1, min(length, steps.normal.shape[0])):
        energy += 2.0 * steps.normal[lag, part].reshape(count, length)[:, : length - lag].sum(axis=1)
    fall = (-2.0 * right - energy) / steps.noise
    clear = energy > CLEAR * steps.noise
    sure = fall > SURE
    cost = 2.0 * np.log(max(count, 2)) * np.count_nonzero(sure)
    return float(fall[sure].sum() - cost), sure, clear
