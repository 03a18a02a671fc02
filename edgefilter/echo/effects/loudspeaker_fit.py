"""The loudspeaker's laws found in a recording: by least squares on half of it, kept where they hold on the other half."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from edgefilter.dsp.membrane import motion
from edgefilter.echo.effects.loudspeaker_laws import AMPLIFIER_TERMS, DRIVER_TERMS, amplifier_terms, driver_terms
from edgefilter.echo.least_squares import NUISANCE_LEAD, NUISANCE_TAPS
from edgefilter.echo.measurement import level_ratio
from edgefilter.echo.recording import BLOCK
from edgefilter.types import Array, Samples

RESONANCES_HZ = (250.0, 160.0, 200.0, 320.0, 400.0)
EXCURSION, KNEES = 0.7, (0.3, 0.15, 0.6)
"""Where the laws bend, re the largest displacement and the highest sample that the fit has seen; the usual ones first."""
PEAK = 0.9999
"""The largest is this quantile."""
RIDGE = 1e-3
LEAST = 0.01
"""Share of what the linear voice leaves on samples that were not fitted to, by which laws lower it that are kept."""
FURTHER = 0.02
"""The same for driver and amplifier together, re the better of the two."""
PROMISING = 0.003
"""The same from which on other resonances and knees are tried."""


@dataclass(frozen=True, eq=False)
class Laws:
    """What was found.

    resonance_hz, excursion: of driver_terms, driver: their weights (6,). knee, amplifier (4,): of amplifier_terms.
    level_db: of what they add at the microphone, re the linear voice and but for what is in proportion to it.
    held_out: the share by which they lower what the linear voice leaves on samples that were not fitted to.
    """

    resonance_hz: float
    excursion: float
    driver: Array
    knee: float
    amplifier: Array
    level_db: float
    held_out: float


@dataclass(frozen=True, eq=False)
class _Part:
    """Driver or amplifier with one setting: its terms at the microphone (used, k), and what is left with them."""

    resonance_hz: float
    scale: float
    columns: Samples
    left: float


def fit_laws(
    x: Samples,
    target: Samples,
    weights: Samples,
    linear: Samples,
    hear: Callable[[Samples], Samples],
    before: Laws | None = None,
) -> Laws | None:
    """The laws that explain a recording best, None where none holds on samples that it was not fitted to.

    Parameters
    ----------
    x
        (n,) what the amplifier is sent.
    target
        (n,) the recording, whitened.
    weights
        (n,) 0 to 1: how much a sample counts.
    linear
        (n,) the linear voice at the microphone, whitened: hear(x).
    hear
        What becomes of a signal (n,) at the loudspeaker up to the microphone, whitened.
    before
        Laws whose resonance, excursion and knee stay as they are; None: these are searched, too.
    """
    used = np.flatnonzero(weights > 0.0)
    halves = _Halves(linear, target, weights, used)
    base, peak = halves.left(np.zeros((used.size, 0), np.float32)), _peak(x[used])
    if peak <= 0.0 or base <= 0.0:
        return None

    def part(terms: Samples, scale: float, resonance_hz: float = 0.0) -> _Part:
        columns = np.stack([hear(term)[used] for term in terms], axis=1)
        return _Part(resonance_hz, scale, columns, halves.left(columns))

    def amplifier(knee: float) -> _Part:
        return part(amplifier_terms(x, knee), knee)

    def driver(hz: float) -> _Part:
        excursion = before.excursion if before else EXCURSION * _peak(motion(x, hz)[0][used])
        return part(driver_terms(x, hz, excursion), excursion, hz)

    promising = (1.0 - PROMISING) * base
    bend = _best(amplifier, [before.knee] if before else [share * peak for share in KNEES], promising)
    move = _best(driver, [before.resonance_hz] if before else RESONANCES_HZ, promising)
    both = np.concatenate((move.columns, bend.columns), axis=1)
    chosen = min(move, bend, key=lambda one: one.left)
    columns, left, together = chosen.columns, chosen.left, halves.left(both)
    if together < (1.0 - FURTHER) * left:
        columns, left = both, together
    if left > (1.0 - LEAST) * base:
        return None
    found, level_db = halves.whole(columns)
    driving = found[:DRIVER_TERMS] if columns is not bend.columns else np.zeros(DRIVER_TERMS)
    bending = found[-AMPLIFIER_TERMS:] if columns is not move.columns else np.zeros(AMPLIFIER_TERMS)
    return Laws(move.resonance_hz, move.scale, driving, bend.scale, bending, level_db, 1.0 - left / base)


def _best(make: Callable[[float], _Part], settings: Sequence[float], promising: float) -> _Part:
    """The first setting, or the best of all where that one leaves less than promising."""
    first = make(settings[0])
    rest = [make(other) for other in settings[1:]] if first.left < promising else []
    return min((first, *rest), key=lambda part: part.left)


def _peak(x: Samples) -> float:
    return float(np.quantile(np.abs(x), PEAK)) if x.size else 0.0


class _Halves:
    """Weighted least squares on either half of the samples (BLOCKs, two by two), judged on the other.

    Beside the columns that are asked about stands the linear voice with NUISANCE_TAPS of a filter: another gain, a
    move by less than a millimetre.
    """

    def __init__(self, linear: Samples, target: Samples, weights: Samples, used: np.ndarray) -> None:
        lags = np.pad(linear, (NUISANCE_TAPS - 1 - NUISANCE_LEAD, NUISANCE_LEAD))
        self._linear = sliding_window_view(lags, NUISANCE_TAPS)[:, ::-1][used]
        self._target = target[used, None]
        self._weights = weights[used, None].astype(np.float32)
        self._first = used // BLOCK % 4 < 2

    def left(self, columns: Samples) -> float:
        """What the linear voice and columns (used, k), fitted to one half, leave on the other: the sum of both ways."""
        first, second = self._normal(columns)
        return _left(first, _solved(second)) + _left(second, _solved(first))

    def whole(self, columns: Samples) -> tuple[Array, float]:
        """Weights (k,) of columns (used, k) re the linear voice's gain, fitted to all, and the level of what they add, dB."""
        first, second = self._normal(columns)
        found = _solved(first + second)
        voice = self._linear[:, NUISANCE_LEAD]
        gain = level_ratio(self._linear @ found[:NUISANCE_TAPS].astype(np.float32), voice) or 1.0
        weights = found[NUISANCE_TAPS:] / gain
        added = columns @ weights.astype(np.float32)
        added -= level_ratio(added, voice) * voice
        level = float(np.dot(added, added)) / (float(np.dot(voice, voice)) + 1e-30)
        return weights, 10.0 * float(np.log10(level + 1e-12))

    def _normal(self, columns: Samples) -> tuple[Array, Array]:
        """Of each half the weighted products of linear voice, columns and target with each other."""
        rows = np.concatenate((self._linear, columns, self._target), axis=1)
        first, second = (
            np.float64((rows[half] * self._weights[half]).T @ rows[half]) for half in (self._first, ~self._first)
        )
        return first, second


def _solved(normal: Array) -> Array:
    """Weights (k,) of normal equations (k + 1, k + 1), the target the last; the ridge is on all but the linear voice."""
    matrix, right = normal[:-1, :-1], normal[:-1, -1]
    scale = np.sqrt(matrix.diagonal()) + 1e-30
    ridge = np.full(scale.size, RIDGE)
    ridge[:NUISANCE_TAPS] = 1e-3 * RIDGE
    return np.linalg.solve(matrix / scale[:, None] / scale + np.diag(ridge), right / scale) / scale


def _left(normal: Array, found: Array) -> float:
    """Energy that weights (k,) leave of the target."""
    residual = np.append(-found, 1.0)
    return max(float(residual @ normal @ residual), 0.0)
