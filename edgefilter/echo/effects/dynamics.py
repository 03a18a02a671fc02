"""A gain that follows the voice's own level by a law that is free: compressor, limiter, expander, gate or normaliser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from edgefilter.dsp.frames import block_power, blocks, decibels
from edgefilter.echo.effect import Effect, Experiment, Parameter, Runner, Stage, as_array, neutral
from edgefilter.echo.effects.multiband_compression import RESOLUTION_HZ, Crossover, find_crossovers, moved
from edgefilter.echo.least_squares import normal_equations
from edgefilter.echo.measurement import Measurement, Values, VoiceModel, level_ratio
from edgefilter.echo.wiener import spectra
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

STEP = 16
"""Samples (1 ms) from one value of the level to the next."""
KNOTS, SPACING_DB = 11, 5.0
"""Of the gain over the level, down from the loudest: below lies what the fan hides."""
ATTACKS_MS, RELEASES_MS = (0.5, 3.0, 15.0, 60.0, 300.0), (10.0, 40.0, 150.0, 600.0, 2000.0)
FLOORS_DB = (-28.0, -16.0)
"""Starting points; of the floor, re the loudest 20 ms."""
SLOW_MS, STARTS_DB = 300.0, (-30.0, -20.0, -10.0)
"""Release from which on it shows at what level a control stood before the first sound, and what is tried, re the highest knot."""
FINER = (2.0, 1.4)
"""Ratios of times that are tried next on either side of the best."""
AHEAD = (0, 1, 2, 3, 5, 8, 12)
"""Steps by which the gain may come before the level: of a limiter that looks ahead."""
NO_FLOOR_DB, SILENT_DB = -200.0, -80.0
BEND = 1e-4
"""Weight of the curve's second differences, re the voice's mean energy at a knot: where speech hardly comes the curve goes
on as beside it."""
BANDS_WORTH = 0.5
"""Of the energy that one band leaves, what three may leave at most to be preferred: they have three times the numbers."""
LITTLE = 1.3
"""Times the fan's energy that one band leaves where no three are tried."""
ROUNDS = 2
TEMPLATE = """LEVEL_DB = {knots}
BANDS = [  # attack and release in ms, exponent, floor and start in dB, gain in dB at each level
{bands}
]
CROSSOVERS_HZ = {crossovers}


def follow(x, attack_ms, release_ms, exponent, floor_db, start_db, gain_db):
    curve, gain = 10 ** (gain_db / 20), []
    level = max(start_db, -160.0) if exponent == 0 else 10 ** (start_db * exponent / 20)
    for part in np.abs(x[: x.size // {step} * {step}]).reshape(-1, {step}).astype(float):
        now = np.mean(part ** (exponent or 2))
        now = max(10 * np.log10(now + 1e-12), floor_db) if exponent == 0 else now
        level += (1 - np.exp(-{step} / {per_ms} / (attack_ms if now > level else release_ms))) * (now - level)
        gain.append(np.interp(level if exponent == 0 else 20 / exponent * np.log10(level + 1e-12), LEVEL_DB, curve))
    return x * np.interp(np.arange(x.size) / {step} - 2 + {ahead:g}, np.arange(len(gain)), gain) if gain else x


def law(x, sample_rate):
    bands, rest = [], np.roll(x, {delay})
    for hz in CROSSOVERS_HZ:
        low, high = (signal.butter(2, hz, kind, fs=sample_rate, output="sos") for kind in ("low", "high"))
        bands.append(signal.sosfilt(np.tile(low, (2, 1)), rest))
        rest = signal.sosfilt(np.tile(high, (2, 1)), rest)
    return sum(follow(band, *numbers) for band, numbers in zip([*bands, rest], BANDS))"""


class Dynamics(Effect):
    """y = g(L) x, g a curve through knots, L the level of x smoothed with an attack and a release; in one band or in three.

    level_db: (k,) of the knots. gain_db: (k,), or (3 k,) from the low band to the high one. crossover_hz: 0, or (2,) where
    bands are cut as in `multiband_compression`; delay: of the whole then. attack_ms, release_ms, exponent, floor_db: one
    or (3,): what rises and falls exponentially is |x|^exponent, or for 0 its level in dB, held above floor_db (a control
    that smooths the gain instead of the level, Giannoulis, Massberg & Reiss 2012, section 2.3). start_db: the level before the
    first sound. ahead_ms: by which the
    gain precedes the level.
    """

    name: ClassVar[str] = "dynamics"
    stage: ClassVar[Stage] = "source"
    family: ClassVar[str] = "dynamics"
    title: ClassVar[str] = "a gain that follows the level"
    cost: ClassVar[int] = 6
    complexity: ClassVar[int] = 3
    flexible: ClassVar[bool] = True
    shown_by: ClassVar[tuple[Experiment, ...]] = ("levels",)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("level_db", "dB re full scale", 0.0, NO_FLOOR_DB, 40.0, given=True),
        Parameter("gain_db", "dB", 0.0, -60.0, 60.0),
        Parameter("crossover_hz", "Hz", 0.0, 0.0, 7500.0, given=True),
        Parameter("attack_ms", "ms", 5.0, 0.01, 5000.0),
        Parameter("release_ms", "ms", 100.0, 0.01, 20000.0),
        Parameter("exponent", "1", 1.0, 0.0, 2.0, given=True),
        Parameter("floor_db", "dB re full scale", NO_FLOOR_DB, NO_FLOOR_DB, 40.0, given=True),
        Parameter("start_db", "dB re full scale", NO_FLOOR_DB, NO_FLOOR_DB, 40.0, given=True),
        Parameter("ahead_ms", "ms", 0.0, 0.0, 100.0, given=True),
        Parameter("delay", "samples", 0.0, -100.0, 100.0, given=True),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """X (n,), each of its bands times the gain that its level asks for."""
        if np.size(values["level_db"]) < 2:
            return x.copy()
        ahead = round(float(values["ahead_ms"]) * 1e-3 * sample_rate / STEP) * STEP
        return Controls(values, sample_rate).turned(moved(x, float(values["delay"])), ahead)

    def run(self, values: Values, sample_rate: int) -> Runner | None:
        """The controls, which carry their levels on; the stream has no samples ahead of the voice, and where that is the aligner says."""
        return Controls(values, sample_rate) if np.size(values["level_db"]) > 1 else None

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The times from a grid, each judged by the curve that fits best; then the curve beside the others by least squares.

        Three bands where the spectra show crossovers and these leave much less than one.
        """
        x = measurement.reference
        loud_db = float(decibels(np.max(block_power(x, SAMPLE_RATE // 50), initial=0.0)))
        if loud_db < SILENT_DB or not measurement.weights.any():
            return neutral(self)
        knots = np.ceil(loud_db) + 6.0 + SPACING_DB * np.arange(-KNOTS + 1.0, 1.0)
        one = _fitted(measurement, model, [x], knots, _starts(loud_db))
        if one.left < LITTLE * np.sum(measurement.weights):
            return one.values(knots)
        crossed = find_crossovers(spectra(measurement, measurement.heard(model)[1], RESOLUTION_HZ))
        if crossed is not None:
            low, high, delay = crossed
            crossovers = np.array([low, high])
            bands = cut(moved(x, delay), [Crossover(hz, SAMPLE_RATE) for hz in crossovers])
            three = _fitted(measurement, model, bands, knots, BAND_STARTS)
            if three.left < BANDS_WORTH * one.left:
                return {**three.values(knots), "crossover_hz": crossovers, "delay": delay}
        return one.values(knots)

    def sentence(self, values: Values) -> str:
        """How the gain changes with the level, and how fast."""
        if np.size(values["level_db"]) < 2:
            return "the gain does not follow the level"
        return _said(values)

    def code(self, values: Values) -> str:
        """The gain by level as a table, and the follower of the level, band by band."""
        crossovers, knots = np.ravel(values["crossover_hz"]), np.ravel(values["level_db"]).astype(float)
        crossovers = crossovers[crossovers > 0.0]
        rows = zip(_settings(values), np.ravel(values["gain_db"]).reshape(-1, knots.size), strict=True)
        bands = [
            f"    ({s.attack_ms:.2f}, {s.release_ms:.1f}, {s.exponent:g}, {s.floor_db:.1f}, {s.start_db:.1f},\n     {as_array(gain_db, 2)}),"
            for s, gain_db in rows
        ]
        ahead = float(values["ahead_ms"]) * 1e-3 * SAMPLE_RATE / STEP
        return TEMPLATE.format(
            knots=as_array(knots, 1), bands="\n".join(bands), crossovers=np.round(crossovers, 1).tolist(),
            step=STEP, per_ms=SAMPLE_RATE // 1000, ahead=ahead, delay=round(float(values["delay"])),
        )  # fmt: skip


def _settings(values: Values) -> list[Setting]:
    """How the level of each band is smoothed."""
    count = np.count_nonzero(values["crossover_hz"]) + 1
    names = ("exponent", "attack_ms", "release_ms", "floor_db", "start_db")
    each = [np.broadcast_to(np.ravel(values[name]).astype(float), (count,)) for name in names]
    return [Setting(*map(float, row)) for row in zip(*each, strict=True)]


@dataclass(frozen=True)
class Setting:
    """How a level is smoothed: exponent, attack and release in ms, floor in dB."""

    exponent: float
    attack_ms: float
    release_ms: float
    floor_db: float
    start_db: float = NO_FLOOR_DB

    @property
    def rest(self) -> float:
        """What is smoothed, before the first sound."""
        start = max(self.start_db, 2.0 * SILENT_DB)
        return 10.0 ** (start * self.exponent / 20.0) if self.exponent else max(start, self.floor_db)


BAND_STARTS = [Setting(1.0, attack, release, NO_FLOOR_DB) for attack in (2.0, 20.0) for release in (30.0, 150.0)]
"""Settings that the search of each of three bands begins with."""


@dataclass(frozen=True, eq=False)
class _Laws:
    """settings: of each band. curves: (bands, k) gains, linear. ahead: steps. left: energy on the samples of the fit."""

    settings: tuple[Setting, ...]
    curves: Array
    ahead: int
    left: float

    def values(self, knots: Array) -> dict[str, float | Array]:
        of = {
            name: np.array([getattr(s, name) for s in self.settings])
            for name in ("attack_ms", "release_ms", "exponent", "floor_db", "start_db")
        }
        return {
            "level_db": knots,
            "gain_db": np.clip(20.0 * np.log10(np.maximum(self.curves, 1e-3)), -60.0, 60.0).ravel(),
            "ahead_ms": 1e3 * self.ahead * STEP / SAMPLE_RATE,
            **{name: float(array[0]) if array.size == 1 else array for name, array in of.items()},
        }


class Controls:
    """The gain of each band on a stream: values as of Dynamics, behind what moves the whole."""

    def __init__(self, values: Values, sample_rate: int) -> None:
        knots = np.ravel(values["level_db"]).astype(float)
        crossovers = np.ravel(values["crossover_hz"]).astype(float)
        self._crossovers = [Crossover(hz, sample_rate) for hz in crossovers if hz > 0.0]
        gains = 10.0 ** (np.ravel(values["gain_db"]).astype(float).reshape(-1, knots.size) / 20.0)
        curves = np.broadcast_to(gains, (len(self._crossovers) + 1, knots.size))
        self._controls = [
            _Control(setting, knots, curve[None]) for setting, curve in zip(_settings(values), curves, strict=True)
        ]

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        """X (n,), which follows what came before, times its gains."""
        return self.turned(x, 0)

    def turned(self, x: Samples, ahead: int) -> Samples:
        """X (n,) times the gains of so many samples later."""
        out = np.zeros(x.size, np.float32)
        bands = cut(np.pad(x, (0, ahead)), self._crossovers)
        for control, band in zip(self._controls, bands, strict=True):
            out += band[: x.size] * control(band)[0, ahead:]
        return out


class _Control:
    """One band's gains on a stream by m curves (m, k) over its level: of the last two whole steps, drawn straight."""

    def __init__(self, setting: Setting, knots: Array, curves: Array) -> None:
        self._setting, self._knots, self._curves = setting, knots, curves
        self._state = np.array([setting.rest])
        self._rest = np.zeros(0, np.float32)
        self._gains = np.repeat(curves[:, :1], 2, axis=1)

    def __call__(self, x: Samples) -> Samples:
        """The gains (m, n) at the next samples x (n,)."""
        begun, whole = self._rest.size, np.concatenate((self._rest, x))
        level, self._state = smoothed(whole, [self._setting], self._state)
        self._rest = whole[level.size * STEP :]
        gains = np.stack([np.interp(level[0], self._knots, curve) for curve in self._curves])
        gains = np.concatenate((self._gains, gains), axis=1)
        self._gains = gains[:, -2:]
        at, steps = (begun + np.arange(x.size)) / STEP, np.arange(gains.shape[1])
        return np.stack([np.interp(at, steps, gain) for gain in gains]).astype(np.float32)


def cut(x: Samples, crossovers: Sequence[Crossover]) -> list[Samples]:
    """The bands of x (n,), from low to high, each (n,)."""
    bands, rest = [], x
    for crossover in crossovers:
        low, rest = crossover(rest)
        bands.append(low)
    return [*bands, rest]


def smoothed(x: Samples, settings: Sequence[Setting], state: Array) -> tuple[Array, Array]:
    """(m, k) level in dB at the end of each whole step of x (n,), by m settings, and what these go on with (m,)."""
    steps = np.abs(blocks(x, STEP)).astype(np.float64)
    power = np.mean(steps * steps, axis=1)
    drives = {0.0: decibels(power), 1.0: np.mean(steps, axis=1), 2.0: power}
    asked = np.stack(
        [np.maximum(drives[s.exponent], s.floor_db) if s.exponent == 0.0 else drives[s.exponent] for s in settings],
        axis=1,
    )
    rising, falling = (
        -np.expm1(-1e3 * STEP / SAMPLE_RATE / np.array(ms))
        for ms in zip(*((s.attack_ms, s.release_ms) for s in settings), strict=True)
    )
    level = _followed(asked, state, rising, falling)
    state = level[-1].copy() if level.size else state
    for row, s in zip(level.T, settings, strict=True):
        if s.exponent:
            np.log10(np.maximum(row, 1e-12), out=row)
            row *= 20.0 / s.exponent
    return np.ascontiguousarray(level.T), state


def _followed(asked: Array, state: Array, rising: Array, falling: Array) -> Array:
    """(k, m) what rises and falls exponentially towards asked (k, m), from state (m,) on; written into asked."""
    if state.size == 1:  # a plain loop is faster for one
        now, up, down, found = float(state[0]), float(rising[0]), float(falling[0]), []
        for wanted in asked[:, 0].tolist():
            now += (up if wanted > now else down) * (wanted - now)
            found.append(now)
        return np.array(found).reshape(-1, 1)
    for row in asked:
        step = row - state
        state = state + np.where(step > 0.0, rising, falling) * step
        row[:] = state
    return asked


def _starts(loud_db: float) -> list[Setting]:
    """Settings that one band's search begins with."""
    floors = {0.0: (NO_FLOOR_DB, *(loud_db + db for db in FLOORS_DB)), 1.0: (NO_FLOOR_DB,), 2.0: (NO_FLOOR_DB,)}
    return [Setting(p, a, r, f) for p in floors for a, r, f in product(ATTACKS_MS, RELEASES_MS, floors[p])]


def _fitted(
    measurement: Measurement, model: VoiceModel, bands: list[Samples], knots: Array, starts: list[Setting]
) -> _Laws:
    """The laws of the given bands of the reference, each band's times found with the others as they are known by then."""
    heard = (
        [measurement.heard(model)[1]]
        if len(bands) == 1
        else [measurement.whiten(model.predict(band)) for band in bands]
    )
    target, weights = measurement.white_recording, measurement.weights
    parts = [level_ratio(target, voice) * voice for voice in heard]
    chosen: list[tuple[Setting, int]] = [(Setting(1.0, 5.0, 100.0, NO_FLOOR_DB), 0)] * len(bands)
    for _ in range(ROUNDS if len(bands) > 1 else 1):
        for i, band in enumerate(bands):
            others = np.sum(parts[:i] + parts[i + 1 :], axis=0) if len(bands) > 1 else np.float32(0.0)
            grid = _Grid(band, heard[i], target - others, weights, knots)
            chosen[i] = grid.search(starts, float(knots[-1]))
            parts[i] = heard[i] * grid.gain(*chosen[i])
    ahead = chosen[0][1] if len(bands) == 1 else 0
    columns = []
    for (setting, _), band in zip(chosen, bands, strict=True):
        hats = _Control(setting, knots, np.eye(knots.size))(np.pad(band, (0, ahead * STEP)))[:, ahead * STEP :]
        columns += [measurement.whiten(model.predict(band * hat)) for hat in hats]
    normal = normal_equations(columns, target, 1, 0, weights > 0.0)
    curves, left = _solved(normal.matrix, normal.right, len(bands))
    return _Laws(tuple(setting for setting, _ in chosen), curves, ahead, normal.energy + left)


class _Grid:
    """Settings of one band's level, each judged by what the best curve over it explains; the path's length is left out of account."""

    def __init__(self, band: Samples, heard: Samples, target: Samples, weights: Samples, knots: Array) -> None:
        self._band, self._knots, self._size = band, knots, heard.size
        at_source = [np.roll(product_ * weights, -PRE_ROLL) for product_ in (heard * heard, heard * target)]
        self._energy, self._cross = (blocks(part, STEP).sum(axis=1, dtype=np.float64) for part in at_source)

    def search(self, starts: list[Setting], loud_db: float) -> tuple[Setting, int]:
        """The best setting of these, then of finer ones around it; and by how many steps the gain comes before the level."""
        best = self._best(starts)
        for ratio in FINER:
            around = (1.0 / ratio, 1.0, ratio)
            moves = (-3.0 * ratio + 2.0, 0.0, 3.0 * ratio - 2.0) if best.floor_db > NO_FLOOR_DB else (0.0,)
            near = product(around, around, moves)
            best = self._best(
                [Setting(best.exponent, best.attack_ms * a, best.release_ms * r, best.floor_db + f) for a, r, f in near]
            )
        if best.release_ms > SLOW_MS:
            best = self._best([best, *(replace(best, start_db=loud_db + db) for db in STARTS_DB)])
        level = self._levels([best])[0]
        worth = [self._worth(np.roll(level, -steps))[0] for steps in AHEAD]
        return best, AHEAD[int(np.argmax(worth))]

    def gain(self, setting: Setting, ahead: int) -> Samples:
        """(n,) of the voice at the microphone, by the curve that fits best."""
        level = np.roll(self._levels([setting])[0], -ahead)
        curve = self._worth(level)[1]
        gain = np.interp(level, self._knots, curve)
        return np.interp(np.arange(self._size) - PRE_ROLL, STEP * (np.arange(gain.size) + 0.5), gain).astype(np.float32)

    def _best(self, settings: list[Setting]) -> Setting:
        return settings[int(np.argmax([self._worth(track)[0] for track in self._levels(settings)]))]

    def _levels(self, settings: list[Setting]) -> Array:
        return smoothed(self._band, settings, np.array([s.rest for s in settings]))[0]

    def _worth(self, level: Array) -> tuple[float, Array]:
        """Energy that the best curve over a level (k,) explains, and that curve."""
        count = self._knots.size
        place = np.clip((level - self._knots[0]) / SPACING_DB, 0.0, count - 1 - 1e-9)
        knot = place.astype(np.intp)
        upper = place - knot
        lower = 1.0 - upper

        def sums(x: Array, at: NDArray[np.intp]) -> Array:
            return np.bincount(at, x, count).astype(np.float64)

        energy, cross = self._energy, self._cross
        across = sums(energy * upper * lower, knot)[:-1]
        matrix = (
            np.diag(sums(energy * lower**2, knot) + sums(energy * upper**2, knot + 1))
            + np.diag(across, 1)
            + np.diag(across, -1)
        )
        right = sums(cross * lower, knot) + sums(cross * upper, knot + 1)
        curve, left = _solved(matrix, right, 1)
        return -left, curve[0]


def _solved(matrix: Array, right: Array, bands: int) -> tuple[Array, float]:
    """Curves (bands, k) of least squares, their bends held small, and the change of the energy left."""
    count = right.size // bands
    bends, steps = (np.diff(np.eye(count), order, axis=0) for order in (2, 1))
    held = np.kron(np.eye(bands), BEND * bends.T @ bends + 1e-2 * BEND * steps.T @ steps + 1e-6 * BEND * np.eye(count))
    found = np.linalg.solve(matrix + held * (np.trace(matrix) / right.size + 1e-30), right)
    return found.reshape(bands, count), float(found @ matrix @ found - 2.0 * found @ right)


def _said(values: Values) -> str:
    """The steepest part of the curve in words, and the times."""
    knots = np.ravel(values["level_db"]).astype(float)
    curves = np.ravel(values["gain_db"]).astype(float).reshape(-1, knots.size)
    slopes = np.diff(curves, axis=1) / np.diff(knots)
    band, place = np.unravel_index(np.argmax(np.abs(slopes)), slopes.shape)
    slope, times = slopes[band, place], [np.ravel(values[key]).astype(float) for key in ("attack_ms", "release_ms")]
    attack, release = (float(np.broadcast_to(ms, (curves.shape[0],))[band]) for ms in times)
    return (
        f"the gain {'falls' if slope < 0 else 'rises'} by up to {abs(10 * slope):.0f} dB per 10 dB of level, around"
        f" {0.5 * (knots[place] + knots[place + 1]):.0f} dB, within {attack:.2g} ms, and comes back in {release:.3g} ms"
        + (f", each of {curves.shape[0]} bands by a law of its own" if curves.shape[0] > 1 else "")
    )
