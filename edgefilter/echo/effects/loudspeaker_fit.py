"""The loudspeaker's laws found in a recording: by least squares on half of it, kept where they hold on the other half."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from edgefilter.dsp.membrane import motion
from edgefilter.echo.effects.loudspeaker_laws import AMPLIFIER_TERMS, DRIVER_TERMS, amplifier_terms, driver_terms
from edgefilter.echo.least_squares import CHUNK, NUISANCE_LEAD, NUISANCE_TAPS
from edgefilter.echo.measurement import level_ratio
from edgefilter.echo.recording import BLOCK
from edgefilter.types import Array, Samples

RESONANCES_HZ = (250.0, 180.0, 215.0, 300.0, 370.0)
REACH_HZ = (160.0, 1000.0)
BESIDE = 1.1
"""Resonances that are tried to either side of the best of these."""
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
    gain_db: of the linear voice beside them.
    held_out: the share by which they lower what the linear voice leaves on samples that were not fitted to.
    """

    resonance_hz: float
    excursion: float
    driver: Array
    knee: float
    amplifier: Array
    level_db: float
    gain_db: float
    held_out: float


@dataclass(frozen=True, eq=False)
class _Part:
    """Driver (setting: its resonance) or amplifier: where it bends, its terms at the microphone (used, k), what is left with them."""

    setting: float
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
    excerpt: slice | None = None,
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
        Laws from whose resonance and knee the search sets out, for the parts that bend in them; None: from the usual
        ones, for both.
    excerpt
        The samples on which resonance, excursion and knee are chosen; None: all.
    """
    search = _Search(x, hear, _Halves(linear, target, weights))
    if search.base <= 0.0 or search.peak <= 0.0:
        return None
    if excerpt is None:
        bend, move = search.amplifier(before), search.driver(before)
    else:
        part = _Search(x[excerpt], hear, _Halves(linear[excerpt], target[excerpt], weights[excerpt]))
        if part.base <= 0.0 or part.peak <= 0.0:
            return None
        bend, move = part.amplifier(before), part.driver(before)
        if not (part.promising(bend) or part.promising(move)):
            return None
        bend, move = search.as_in(bend), search.as_in(move)
    parts = [min(move, bend, key=_by_left)]
    left, together = parts[0].left, search.halves.left(np.concatenate((move.columns, bend.columns), axis=1))
    if together < (1.0 - FURTHER) * left:
        parts, left = [move, bend], together
    if left > (1.0 - LEAST) * search.base:
        return None
    found, level_db, gain_db = search.halves.whole(np.concatenate([part.columns for part in parts], axis=1))
    driving = found[:DRIVER_TERMS] if move in parts else np.zeros(DRIVER_TERMS)
    bending = found[-AMPLIFIER_TERMS:] if bend in parts else np.zeros(AMPLIFIER_TERMS)
    return Laws(move.setting, move.scale, driving, bend.scale, bending, level_db, gain_db, 1.0 - left / search.base)


class _Search:
    """Settings of driver and amplifier, each scored by what is left with it on samples that it was not fitted to.

    base: what the linear voice alone leaves there. peak: the highest sample that counts.
    """

    def __init__(self, x: Samples, hear: Callable[[Samples], Samples], halves: _Halves) -> None:
        self._x, self._hear, self.halves = x, hear, halves
        self._nothing = np.zeros((halves.used.size, 0), np.float32)
        self.base, self.peak = halves.left(self._nothing), _peak(x[halves.used])

    def amplifier(self, before: Laws | None) -> _Part:
        """The best knee, or the one before."""
        if before is not None and not before.amplifier.any():
            return _Part(0.0, before.knee, self._nothing, self.base)

        def make(knee: float) -> _Part:
            return self._part(0.0, knee, amplifier_terms(self._x, knee))

        return self._best(make, [share * self.peak for share in KNEES] if before is None else [before.knee])

    def driver(self, before: Laws | None) -> _Part:
        """The best resonance, or the best beside the one before, and excursion."""
        if before is not None and not before.driver.any():
            return _Part(before.resonance_hz, before.excursion, self._nothing, self.base)

        def make(hz: float, share: float = EXCURSION) -> _Part:
            excursion = share * _peak(motion(self._x, hz)[0][self.halves.used])
            return self._part(hz, excursion, driver_terms(self._x, hz, excursion))

        best = self._best(make, RESONANCES_HZ if before is None else [before.resonance_hz])
        if self.promising(best):
            beside = [float(np.clip(best.setting * step, *REACH_HZ)) for step in (1.0 / BESIDE, BESIDE)]
            best = min(best, *map(make, beside), key=_by_left)
            best = min(best, make(best.setting, 0.5 * EXCURSION), key=_by_left)
        return best

    def as_in(self, part: _Part) -> _Part:
        """A part as another search has set it."""
        terms = (
            driver_terms(self._x, part.setting, part.scale) if part.setting else amplifier_terms(self._x, part.scale)
        )
        return self._part(part.setting, part.scale, terms)

    def _best(self, make: Callable[[float], _Part], settings: Sequence[float]) -> _Part:
        """The first setting, or the best of all where that one is promising."""
        first = make(settings[0])
        return min((first, *map(make, settings[1:])), key=_by_left) if self.promising(first) else first

    def promising(self, part: _Part) -> bool:
        """Whether it lowers what the linear voice leaves enough for a closer look."""
        return part.left < (1.0 - PROMISING) * self.base

    def _part(self, setting: float, scale: float, terms: Samples) -> _Part:
        columns = self.halves.columns(map(self._hear, terms), len(terms))
        return _Part(setting, scale, columns, self.halves.left(columns))


def _by_left(part: _Part) -> float:
    return part.left


def _peak(x: Samples) -> float:
    return float(np.quantile(np.abs(x), PEAK)) if x.size else 0.0


class _Halves:
    """Weighted least squares on either half of the samples (BLOCKs, two by two), tested on the other.

    Beside the columns that are asked about stands the linear voice with NUISANCE_TAPS of a filter: another gain, a
    move by less than a millimetre.
    """

    def __init__(self, linear: Samples, target: Samples, weights: Samples) -> None:
        used = np.flatnonzero(weights > 0.0)
        first = used // BLOCK % 4 < 2
        self.used = np.concatenate((used[first], used[~first]))
        self._split = int(np.count_nonzero(first))
        self._root = np.sqrt(weights[self.used, None].astype(np.float32))
        lags = np.pad(linear, (NUISANCE_TAPS - 1 - NUISANCE_LEAD, NUISANCE_LEAD))
        self._linear = sliding_window_view(lags, NUISANCE_TAPS)[:, ::-1]
        self._target = target[self.used, None] * self._root

    def columns(self, signals: Iterable[Samples], count: int) -> Samples:
        """Signals (n,) at the samples that count, the first half's in front, weighted, (used, count)."""
        out = np.empty((self.used.size, count), np.float32)
        for column, signal in zip(out.T, signals, strict=True):
            np.multiply(signal[self.used], self._root[:, 0], out=column)
        return out

    def left(self, columns: Samples) -> float:
        """What the linear voice and columns (used, k), fitted to one half, leave on the other: the sum of both ways."""
        first, second = self._normal(columns)
        return _left(first, _solved(second)) + _left(second, _solved(first))

    def whole(self, columns: Samples) -> tuple[Array, float, float]:
        """Weights of columns (used, k) re the linear voice's gain, (k,), fitted to all; the level of what they add, and that gain, dB."""
        first, second = self._normal(columns)
        found = _solved(first + second)
        voice, filtered = self._voice(np.eye(NUISANCE_TAPS)[NUISANCE_LEAD]), self._voice(found[:NUISANCE_TAPS])
        gain = level_ratio(filtered, voice) or 1.0
        weights = found[NUISANCE_TAPS:] / gain
        added = columns @ weights.astype(np.float32)
        added -= level_ratio(added, voice) * voice
        level = float(np.dot(added, added)) / (float(np.dot(voice, voice)) + 1e-30)
        return weights, 10.0 * float(np.log10(level + 1e-12)), 20.0 * float(np.log10(max(abs(gain), 1e-3)))

    def _voice(self, taps: Array) -> Samples:
        """The linear voice through taps (NUISANCE_TAPS,), weighted, (used,)."""
        return (self._linear @ taps.astype(np.float32))[self.used] * self._root[:, 0]

    def _normal(self, columns: Samples) -> tuple[Array, Array]:
        """Of each half the weighted products of linear voice, columns and target with each other."""
        first, second = slice(0, self._split), slice(self._split, self.used.size)
        return self._products(columns, first), self._products(columns, second)

    def _products(self, columns: Samples, half: slice) -> Array:
        """A piece at a time, so that memory stays bounded."""
        size = NUISANCE_TAPS + columns.shape[1] + 1
        total = np.zeros((size, size))
        for at in range(half.start, half.stop, CHUNK):
            piece = slice(at, min(at + CHUNK, half.stop))
            linear = self._linear[self.used[piece]] * self._root[piece]
            rows = np.concatenate((linear, columns[piece], self._target[piece]), axis=1)
            total += rows.T @ rows
        return total


def _solved(normal: Array) -> Array:
    """Solve normal equations (k + 1, k + 1), the target the last, for the weights (k,); the ridge is on all but the linear voice."""
    matrix, right = normal[:-1, :-1], normal[:-1, -1]
    scale = np.sqrt(matrix.diagonal()) + 1e-30
    ridge = np.full(scale.size, RIDGE)
    ridge[:NUISANCE_TAPS] = 1e-3 * RIDGE
    return np.linalg.solve(matrix / scale[:, None] / scale + np.diag(ridge), right / scale) / scale


def _left(normal: Array, found: Array) -> float:
    """Energy that weights (k,) leave of the target."""
    residual = np.append(-found, 1.0)
    return max(float(residual @ normal @ residual), 0.0)
