"""A loudspeaker driven hard: its coil, its suspension and its amplifier bend, which adds harmonics and intermodulation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from edgefilter.dsp.membrane import MOTION_TAPS, motion
from edgefilter.echo.effect import Effect, Parameter, first, neutral, within
from edgefilter.echo.effects.gain_fit import EXCERPT, excerpt
from edgefilter.echo.least_squares import CHUNK, NUISANCE_LEAD, NUISANCE_TAPS, RIDGE, at_lags, ridge_solved
from edgefilter.echo.measurement import ORDINARY_DB, Measurement, Values, VoiceModel, level_ratio
from edgefilter.echo.recording import BLOCK
from edgefilter.types import SAMPLE_RATE, Array, Samples

BOUND = 4.0
"""Largest weight: what a law adds to the sound is at most so many times that sound, whatever is played."""
DRIVER, AMPLIFIER = ("force_factor", "stiffness", "damping"), ("even", "odd")
"""Names of the laws of the membrane's driver and of the amplifier; each law has two weights."""
RESONANCES_HZ, REACH_HZ = (250.0, 180.0, 215.0, 300.0, 370.0), (160.0, 1000.0)
"""Of small drivers, the usual one first; how low is tried, where MOTION_TAPS are just enough, and how high."""
EXCURSION, KNEES = 0.7, (0.3, 0.15, 0.6)
"""Where the curves of the loudspeaker's laws bend, relative to the largest displacement and the largest sample in the fit; the usual ones
first. Which of them fits is chosen on the loudest seconds, how much the curves bend is fitted to the whole recording."""
PEAK = 0.9999
"""The largest is this quantile."""
HELD = 1e-3
"""Ridge of the laws' weights, which are more alike than the linear voice's taps."""
LEAST = 0.01
"""Share of what the linear voice leaves on samples that were not fitted to, by which laws lower it that are kept."""
FURTHER = 0.02
"""The same for driver and amplifier together, re the better of the two."""
PROMISING = 0.003
"""The same from which on other resonances and knees are tried."""


class SpeakerNonlinearity(Effect):
    """y = g (x + d), where d is the distortion of the loudspeaker's moving coil and of its amplifier, ahead of the linear path.

    force_factor, stiffness, damping: (2,) a, b of the relative change a s + b s^2 of each, where s is the displacement of the
    membrane, limited to -1..1 (driver_terms). The distorted force moves the same linear membrane as x, whose response is
    part of the path. even, odd: (2,) weights of s x, s^3 x and of s^2 x, s^4 x, where s is the limited input of the amplifier
    (amplifier_terms). resonance_hz: of the membrane. excursion, knee: displacement and amplifier input, relative to full scale, at
    which s is 0.7. level_db: for the report only, level of d without the part proportional to the linear voice. gain_db: 20 log10 g
    of an overdriven amplifier; a volume ahead of it is `playback_gain`. d never grows faster than x, and the model holds while d is
    well below x.
    """

    name = "speaker_nonlinearity"
    stage = "source"
    family = "static nonlinearity"
    title = "loudspeaker nonlinearity"
    flexible = True
    memory = MOTION_TAPS
    parameters = (
        *(Parameter(name, "1", 0.0, -BOUND, BOUND) for name in (*DRIVER, *AMPLIFIER)),
        Parameter("resonance_hz", "Hz", 250.0, *REACH_HZ),
        Parameter("excursion", "full scale", 1.0, 1e-4, 100.0),
        Parameter("knee", "full scale", 1.0, 1e-4, 100.0),
        Parameter("level_db", "dB re the linear voice at the microphone", -120.0, -120.0, 20.0),
        Parameter("gain_db", "dB", 0.0, 0.0, 60.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        out = x.copy()
        driving = np.concatenate([_pair(values, name) for name in DRIVER])
        bending = np.stack([_pair(values, name) for name in AMPLIFIER], axis=1).ravel()
        if driving.any():
            terms = driver_terms(x, first(values, "resonance_hz"), first(values, "excursion"), sample_rate)
            out += driving @ np.stack([*terms])
        if bending.any():
            out += bending @ np.stack([*amplifier_terms(x, first(values, "knee"))])
        gain_db = first(values, "gain_db")
        return out * np.float32(10.0 ** (gain_db / 20.0)) if gain_db else out

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Fit by least squares to the whitened recording; neutral values where no law lowers the error on samples kept apart."""
        linear, x = measurement.predicted(model)[1], measurement.reference
        found = fit_laws(
            x,
            measurement.white_recording,
            measurement.weights,
            linear,
            lambda sound: measurement.heard(model, sound),
            excerpt(measurement, model, EXCERPT),
        )
        if found is None:
            return neutral(self)
        louder = first(found, "gain_db") >= ORDINARY_DB  # a softer voice was turned down, whatever else happened to it
        return within(self, found if louder else {**found, "gain_db": 0.0})

    def sentence(self, values: Values) -> str:
        level_db = first(values, "level_db")
        return (
            f"products of the reference with itself, {level_db:.0f} dB re the voice, are in the residual: no linear"
            " path makes them"
        )


def _pair(values: Values, name: str) -> Array:
    """Two numbers, zero behind a single one, (2,) float32."""
    pair, given = np.zeros(2, np.float32), np.ravel(values[name])[:2]
    pair[: given.size] = given
    return pair


def driver_terms(
    x: Samples, resonance_hz: float, excursion: float, sample_rate: int = SAMPLE_RATE
) -> Iterator[Samples]:
    """The terms s x, s^2 x, -s d, -s^2 d, -s d'/w, -s^2 d'/w for the drive x (n,), (n,) float32 each.

    The equation of motion d'' + (w/Q) d' + w^2 d = w^2 x keeps its left side when force factor, stiffness and damping
    depend on the displacement d; what they change is a drive of its own on the right side (Klippel 2006, "Loudspeaker
    nonlinearities", eq. (2) and (3)). Here to first order: d is the linear membrane's, and each law is a s + b s^2 of
    s = u / sqrt(1 + u^2), u = d / excursion, as of a membrane that can go no farther: nothing grows faster than x.
    """
    moved = motion(x, resonance_hz, sample_rate)
    s = _bent(moved[0], excursion)
    for driven in (x, -moved[0], -moved[1]):
        term = driven * s
        yield term
        yield term * s


def amplifier_terms(x: Samples, knee: float) -> Iterator[Samples]:
    """The terms s x, s^2 x, s^3 x, s^4 x with s = u / sqrt(1 + u^2), u = x / knee, (n,) float32 each."""
    s = _bent(x, knee)
    for _ in range(2 * len(AMPLIFIER)):
        x = x * s
        yield x


def _bent(x: Samples, scale: float) -> Samples:
    """Return u / sqrt(1 + u^2) of u = x / scale (n,): as u where that is small, and never beyond 1."""
    u = x / np.float32(scale)
    return u / np.sqrt(np.float32(1.0) + u * u)


@dataclass(frozen=True, eq=False)
class _Part:
    """A nonlinear driver or amplifier as fitted.

    setting: the driver's resonance in Hz. scale: level at which it becomes nonlinear. columns: (samples used, k), its k terms
    at the microphone. left: what of the recording they leave.
    """

    setting: float
    scale: float
    columns: Samples
    left: float


_by_left = attrgetter("left")


def fit_laws(
    x: Samples,
    target: Samples,
    weights: Samples,
    linear: Samples,
    hear: Callable[[Samples], Samples],
    excerpt: slice,
) -> dict[str, float | Array] | None:
    """The effect's values that explain a recording best, bounds aside; None where no law holds on samples that it was not fitted to.

    x: (n,) what the amplifier is sent. target: (n,) the recording, whitened. weights: (n,) 0 to 1. linear: (n,) hear(x).
    hear: what becomes of a signal (n,) at the loudspeaker up to the microphone, whitened. excerpt: the samples on which
    resonance, excursion and knee are chosen.
    """
    part = _Search(x[excerpt], hear, _Halves(linear[excerpt], target[excerpt], weights[excerpt]))
    if part.silent:
        return None
    bend, move = part.amplifier(), part.driver()
    if not (part.promising(bend) or part.promising(move)):
        return None
    chosen = [(found.setting, found.scale) for found in (bend, move)]
    del part, bend, move  # their columns are as large as those of all samples, which come next
    search = _Search(x, hear, _Halves(linear, target, weights))
    bend, move = (search.part(*each) for each in chosen)
    parts = [min(move, bend, key=_by_left)]
    left, together = parts[0].left, search.halves.left(move.columns, bend.columns)
    if together < (1.0 - FURTHER) * left:
        parts, left = [move, bend], together
    if left > (1.0 - LEAST) * search.base:
        return None
    found, level_db, gain_db = search.halves.whole(*(part.columns for part in parts))
    driving = found[: 2 * len(DRIVER)] if move in parts else np.zeros(2 * len(DRIVER))
    bending = found[-2 * len(AMPLIFIER) :] if bend in parts else np.zeros(2 * len(AMPLIFIER))
    return {
        **dict(zip(DRIVER, driving.reshape(len(DRIVER), 2), strict=True)),
        "even": bending[::2],
        "odd": bending[1::2],
        "resonance_hz": move.setting,
        "excursion": move.scale,
        "knee": bend.scale,
        "level_db": level_db,
        "gain_db": gain_db,
    }


class _Search:
    """Settings of driver and amplifier, each scored by what is left with it on samples that it was not fitted to.

    base: what the linear voice alone leaves there. silent: whether nothing is left, or nothing was played.
    """

    def __init__(self, x: Samples, hear: Callable[[Samples], Samples], halves: _Halves) -> None:
        self._x, self._hear, self.halves = x, hear, halves
        self.base, self._peak = halves.left(), _peak(x[halves.used])
        self.silent = self.base <= 0.0 or self._peak <= 0.0

    def amplifier(self) -> _Part:
        """The best knee."""
        return self._best(lambda knee: self.part(0.0, knee), [share * self._peak for share in KNEES])

    def driver(self) -> _Part:
        """The best resonance and excursion."""

        def make(hz: float, share: float = EXCURSION) -> _Part:
            return self.part(hz, share * _peak(motion(self._x, hz)[0][self.halves.used]))

        best = self._best(make, RESONANCES_HZ)
        if self.promising(best):
            best = min(best, make(best.setting, 0.5 * EXCURSION), key=_by_left)
        return best

    def _best(self, make: Callable[[float], _Part], settings: Sequence[float]) -> _Part:
        """The first setting, or the best of all where that one is promising."""
        first = make(settings[0])
        return min((first, *map(make, settings[1:])), key=_by_left) if self.promising(first) else first

    def promising(self, part: _Part) -> bool:
        """Whether it lowers what the linear voice leaves enough for a closer look."""
        return part.left < (1.0 - PROMISING) * self.base

    def part(self, setting: float, scale: float) -> _Part:
        """Driver of that resonance and excursion, or amplifier (setting 0) of that knee."""
        terms = driver_terms(self._x, setting, scale) if setting else amplifier_terms(self._x, scale)
        columns = self.halves.columns(map(self._hear, terms), 2 * len(DRIVER if setting else AMPLIFIER))
        return _Part(setting, scale, columns, self.halves.left(columns))


def _peak(x: Samples) -> float:
    return float(np.quantile(np.abs(x), PEAK)) if x.size else 0.0


class _Halves:
    """Weighted least squares on either half of the samples (BLOCKs, two by two), tested on the other.

    Beside the columns that are asked about stands the linear voice with NUISANCE_TAPS of a filter.
    """

    def __init__(self, linear: Samples, target: Samples, weights: Samples) -> None:
        used = np.flatnonzero(weights > 0.0)
        first = used // BLOCK % 4 < 2
        self.used = np.concatenate((used[first], used[~first]))
        self._split = int(np.count_nonzero(first))
        self._root = np.sqrt(weights[self.used, None].astype(np.float32))
        self._linear = at_lags(linear, NUISANCE_TAPS, NUISANCE_LEAD)
        self._target = target[self.used, None] * self._root

    def columns(self, signals: Iterable[Samples], count: int) -> Samples:
        """The signals, count of them, (n,), at the samples that count, the first half's in front, weighted, (used, count)."""
        out = np.empty((self.used.size, count), np.float32)
        for column, signal in zip(out.T, signals, strict=True):
            np.multiply(signal[self.used], self._root[:, 0], out=column)
        return out

    def left(self, *columns: Samples) -> float:
        """What the linear voice and columns, (used, k) each, fitted to one half, leave on the other: the sum of both ways."""
        first, second = self._normal(columns)
        return _left(first, _solved(second)) + _left(second, _solved(first))

    def whole(self, *columns: Samples) -> tuple[Array, float, float]:
        """Weights of columns, (used, k) each, re the linear voice's gain, fitted to all; the level of what they add, and that gain, dB."""
        first, second = self._normal(columns)
        found = _solved(first + second)
        voice, filtered = self._voice(np.eye(NUISANCE_TAPS)[NUISANCE_LEAD]), self._voice(found[:NUISANCE_TAPS])
        gain = level_ratio(filtered, voice) or 1.0
        weights = found[NUISANCE_TAPS:] / gain
        ends = np.cumsum([each.shape[1] for each in columns[:-1]], dtype=int)
        shares = np.split(weights.astype(np.float32), ends)
        added: Samples = np.sum([each @ share for each, share in zip(columns, shares, strict=True)], axis=0)
        added -= level_ratio(added, voice) * voice
        level = float(np.dot(added, added)) / (float(np.dot(voice, voice)) + 1e-30)
        return weights, 10.0 * float(np.log10(level + 1e-12)), 20.0 * float(np.log10(max(abs(gain), 1e-3)))

    def _voice(self, taps: Array) -> Samples:
        """The linear voice through taps (NUISANCE_TAPS,), weighted, (used,)."""
        return (self._linear @ taps.astype(np.float32))[self.used] * self._root[:, 0]

    def _normal(self, columns: Sequence[Samples]) -> list[Array]:
        """For each half of the samples used, the normal equations: weighted products of the linear voice, the columns and the target."""
        size = NUISANCE_TAPS + sum(each.shape[1] for each in columns) + 1
        halves = [np.zeros((size, size)), np.zeros((size, size))]
        edges = (0, self._split, self.used.size)
        for total, start, stop in zip(halves, edges[:-1], edges[1:], strict=True):
            for at in range(start, stop, CHUNK):
                piece = slice(at, min(at + CHUNK, stop))
                linear = self._linear[self.used[piece]] * self._root[piece]
                rows = np.concatenate((linear, *(each[piece] for each in columns), self._target[piece]), axis=1)
                total += rows.T @ rows
        return halves


def _solved(normal: Array) -> Array:
    """Weights (k,) that solve normal equations (k + 1, k + 1), the target the last."""
    ridge = np.full(normal.shape[0] - 1, HELD)
    ridge[:NUISANCE_TAPS] = RIDGE
    return ridge_solved(normal[:-1, :-1], normal[:-1, -1], ridge)


def _left(normal: Array, found: Array) -> float:
    """Energy that weights (k,) leave of the target."""
    residual = np.append(-found, 1.0)
    return max(float(residual @ normal @ residual), 0.0)
