"""A free law for each family: a curve, a gain by level or by time, a filter, a lag, with as many numbers as a recording teaches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import ClassVar, TypeAlias

import numpy as np

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.frames import block_power, block_sums, blocks, decibels
from edgefilter.echo.effect import Effect, Parameter, Runner, Shift, Stage, first, neutral, numbers, within
from edgefilter.echo.effects.gain_fit import EXCERPT, STEP, loudest
from edgefilter.echo.least_squares import at_lags, hats, normal_equations
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.echo.wiener import fit_filter
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

SHARES = np.array([0.03, 0.06, 0.1, 0.16, 0.24, 0.35, 0.5, 0.7, 1.0])
"""Knots of a curve to either side, re the highest sample: closer where speech has most of its samples."""
KNOTS, SPACING_DB = 11, 5.0
"""Of the gain over the level, down from the loudest: below lies what the fan hides."""
ATTACKS_MS, RELEASES_MS = (0.5, 3.0, 15.0, 60.0, 300.0), (10.0, 40.0, 150.0, 600.0, 2000.0)
AHEAD_MS = (0, 1, 2, 4, 8)
"""By which the level is heard before the sound that it acts on: a limiter that holds the sound back for so long."""
FLOOR_DB = -120.0
"""Below the rounding of 16 bit: nothing is softer."""
OVER_DB = (6.0, 15.0)
"""Over the loudest 20 ms that a step may reach, by its mean square and by its peak."""
EXPONENTS = (1.0, 0.5, 0.1)
"""Of the power, in which a level is smoothed: detectors of power, of amplitude, and, nearly, of decibels."""
FINER = (2.0, 1.4, 1.2)
"""Ratios of times that are tried next on either side of the best."""
BEND = 1e-4
"""Weight of a curve's second differences, re the voice's mean energy at a knot: where speech hardly comes it goes on as beside it."""
RATES_HZ = (0.5, 150.0)
"""Slower is a drift of the gain; faster is heard as a tone of its own."""
RATES_PER_CYCLE = 24
"""Rates tried per cycle in the whole recording."""
HARMONICS = 4
TAPS, LEAD = 256, 32
"""Of the filter: an echo of 14 ms; longer ones are listed."""
AHEAD_TAPS = 128
"""Of the filter ahead: 8 ms, as far as an equaliser reaches that is not narrow; each costs a prediction a step."""
LEARNT_FROM, NUDGE = 5 * SAMPLE_RATE, 0.01
"""Samples that a Gauss-Newton step looks at, and the change of a tap by which its effect is told."""
LAG_STEP = 1600
"""Samples (100 ms) in which a lag is one number; its curve has a knot a second, so that blocks of half a second that no fit has used
lie between two."""
LAG_ROUNDS = 6
"""Newton steps: each halves at least what is left of a lag of some samples."""
Drawn: TypeAlias = tuple[str, str, Array, Array, str]
"""A law as a curve: name and unit of x, x (k,), y (k,) and its unit."""


class FreeLaw(Effect):
    """What no effect of few numbers explains may be written as the law of a family: it predicts as much, and names no cause.

    No search tries it; where names leave much, the diagnosis does (diagnosis/laws.py).
    """

    free = True
    flexible = True

    @property
    def told(self) -> tuple[Parameter, ...]:
        """None: a law is told by its curve and its sentence."""
        return ()

    def drawn(self, values: Values) -> Drawn:
        """The law as points of a curve, for a plot."""
        raise NotImplementedError

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        ground = _Ground(measurement, model, self.stage == "source")
        found = self.fitted(ground) if bool((ground.x * ground.weights).any()) else {}
        return {**neutral(self), **within(self, found)}

    def fitted(self, ground: _Ground) -> Values:
        """The values that explain most; none where nothing does."""
        raise NotImplementedError


class _Ground:
    """What a law is fitted to: x (n,) that it acts on, heard (n,) whitened at the microphone, the recording, what counts."""

    def __init__(self, measurement: Measurement, model: VoiceModel, ahead: bool) -> None:
        self._measurement, self._model, self._ahead = measurement, model, ahead
        plain, self.heard = measurement.predicted(model)
        self.x = measurement.reference if ahead else plain
        self.target, self.weights = measurement.white_recording, measurement.weights
        self.lag = PRE_ROLL if ahead else 0

    def part(self, x: Samples) -> Samples:
        """Sound at the microphone, whitened, that a component x (n,) of the reference causes through the path."""
        return self._measurement.heard(self._model, x) if self._ahead else self._measurement.whiten(x)

    def solve(self, parts: Sequence[Samples], bends: Array) -> Array:
        """Least-squares weights of x's parts (k, n), their bends (m, k) held small; (k,)."""
        heard = [self.part(part) for part in parts]
        return _solved(*normal_equations(heard, self.target, 1, 0, self.weights > 0.0), bends)[0]

    def sums(self, step: int) -> tuple[Array, Array]:
        """Of each `step` samples of x the energy that they have at the microphone, and their product with the recording."""
        energy, cross = (
            block_sums(np.roll(self.heard * other * self.weights, -self.lag), step)
            for other in (self.heard, self.target)
        )
        return energy, cross


class FreeCurve(FreeLaw):
    """y = f(x), f piecewise linear with f(0) = 0: an amplifier, a tube, a rectifier, a converter. Outside its knots it keeps its last slope."""

    name = "free_curve"
    stage: ClassVar[Stage] = "source"
    family = "static nonlinearity"
    title = "a curve that each sample goes through"
    memory = 0
    parameters = (
        Parameter("peak", "full scale", 1.0, 1e-6, 100.0),
        Parameter("bend", "of peak", 0.0, -10.0, 10.0),  # f(x) - x at the knots
    )
    knots: ClassVar[Array] = np.concatenate((-SHARES[::-1], [0.0], SHARES))

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        peak, shares = first(values, "peak"), self.knots
        ends = np.concatenate(([-5.0], shares, [5.0]))
        bend = numbers(values, "bend", shares.size)
        slopes = np.diff(bend)[[0, -1]] / np.diff(shares)[[0, -1]]
        heights = np.concatenate(([bend[0] - 4.0 * slopes[0]], bend, [bend[-1] + 4.0 * slopes[1]]))
        return (x + peak * np.interp(x / peak, ends, heights)).astype(np.float32)

    def fitted(self, ground: _Ground) -> Values:
        middle, knots = SHARES.size, self.knots
        peak = float(np.max(np.abs(ground.x * (ground.weights > 0.0))))
        slopes = np.diff(np.eye(knots.size), axis=0) / np.diff(knots)[:, None]
        bends = np.delete(np.diff(slopes, axis=0), middle, axis=1)
        bends *= 1.0 / np.sqrt(np.trace(bends.T @ bends) / bends.shape[1])
        parts = np.delete(hats(ground.x / peak, knots, beyond=True), middle, axis=0)
        return {"peak": peak, "bend": np.insert(ground.solve(list(parts), bends) / peak, middle, 0.0) - knots}

    def drawn(self, values: Values) -> Drawn:
        knots = np.delete(self.knots, SHARES.size)
        heights = knots + np.delete(numbers(values, "bend", self.knots.size), SHARES.size)
        gain = heights / knots
        middle = 0.5 * (gain[SHARES.size - 1] + gain[SHARES.size]) or 1.0
        gain_db = _gain_db(gain / middle)
        return "the sample's value", "of full scale", knots * first(values, "peak"), gain_db, "dB"

    def sentence(self, values: Values) -> str:
        *_, gain_db, _ = self.drawn(values)
        return (
            f"each sample goes through one curve, which gives {gain_db[-1]:+.1f} dB at its upper end and {gain_db[0]:+.1f}"
            " dB at its lower end of what it gives in its middle"
        )


@dataclass(frozen=True)
class Times:
    """How the level that drives a gain is smoothed.

    attack_ms, release_ms: time constants while it rises and falls. ahead_ms: look-ahead. peak: whether each STEP of samples
    counts by its largest square, not by its mean square. exponent: the signal's power is raised to it, then smoothed.
    """

    attack_ms: float
    release_ms: float
    ahead_ms: int
    peak: bool
    exponent: float


class FreeGain(FreeLaw):
    """g(L) x, L the level of x, its power, or a root of it, smoothed: compressor, limiter, expander, gate, normaliser."""

    name = "free_gain"
    stage: ClassVar[Stage] = "source"
    family = "dynamics"
    title = "a gain by level"
    parameters = (
        Parameter("loudest_db", "dB re full scale", 0.0, -100.0, 100.0),
        Parameter("gain_db", "dB", 0.0, -40.0, 40.0),  # at knots SPACING_DB apart, up to loudest_db
        Parameter("attack_ms", "ms", 10.0, 0.01, 10_000.0),
        Parameter("release_ms", "ms", 100.0, 0.01, 100_000.0),
        Parameter("ahead_ms", "ms", 0.0, 0.0, 100.0),
        Parameter("peak", "0 or 1", 0.0, 0.0, 1.0),  # whether a step of 1 ms counts by its peak, or by its mean square
        Parameter("exponent", "of power", 1.0, 0.01, 10.0),
    )

    def run(self, values: Values, sample_rate: int) -> Runner:
        return _GainByLevel(values)

    def fitted(self, ground: _Ground) -> Values:
        loud_db = float(np.ceil(decibels(np.max(block_power(ground.x, SAMPLE_RATE // 50)))))
        bends = np.concatenate((np.diff(np.eye(KNOTS), 2, axis=0), 0.1 * np.diff(np.eye(KNOTS), axis=0)))
        part = loudest(ground.x, ground.weights > 0.0, EXCERPT)
        steps = slice(part.start // STEP, part.stop // STEP)
        energy, cross = (sums[steps] for sums in ground.sums(STEP))
        x = ground.x[steps.start * STEP : steps.stop * STEP]

        def knots(times: Times) -> Array:
            return _level_knots(loud_db + OVER_DB[times.peak])

        def best(settings: list[Times]) -> Times:
            def worth(level: Array, times: Times) -> float:
                parts = hats(level, knots(times))
                return _solved((parts * energy) @ parts.T, parts @ cross, bends)[1]

            new = [times for times in settings if times not in known]
            known.update(zip(new, map(worth, _levels(x, new), new), strict=True))
            return max(settings, key=known.__getitem__)

        times, known = Times(1.0, 1.0, 0, False, 1.0), dict[Times, float]()
        for _ in range(2):
            times = best([replace(times, attack_ms=a, release_ms=r) for a, r in product(ATTACKS_MS, RELEASES_MS)])
            for ratio in FINER:
                by = (1.0 / ratio, 1.0, ratio)
                around = [(times.attack_ms * a, times.release_ms * r) for a, r in product(by, by)]
                times = best([replace(times, attack_ms=a, release_ms=r) for a, r in around])
            detectors = product(AHEAD_MS, (False, True), EXPONENTS)
            times = best([replace(times, ahead_ms=ahead, peak=peak, exponent=e) for ahead, peak, e in detectors])
        level = _levels(ground.x, [times])[0]
        drawn = np.interp(
            np.arange(ground.x.size) / STEP, np.arange(level.size + 1), np.concatenate((level[:1], level))
        )
        gain = ground.solve([ground.x * hat for hat in hats(drawn, knots(times))], bends)
        gain_db = np.clip(20.0 * np.log10(np.maximum(gain, 1e-3)), -40.0, 40.0)
        return {
            "loudest_db": loud_db + OVER_DB[times.peak],
            "gain_db": gain_db,
            **vars(times),
            "peak": float(times.peak),
        }

    def drawn(self, values: Values) -> Drawn:
        return "level", "dBFS", _level_knots(first(values, "loudest_db")), numbers(values, "gain_db", KNOTS), "dB"

    def sentence(self, values: Values) -> str:
        _, _, knots, gain_db, _ = self.drawn(values)
        top = first(values, "loudest_db") - OVER_DB[int(first(values, "peak"))]
        inside = (knots > top - 35.0) & (knots <= top + SPACING_DB)
        slopes = np.diff(gain_db) / SPACING_DB * inside[1:]
        steepest, ahead = int(np.argmax(np.abs(slopes))), first(values, "ahead_ms")
        return (
            f"a gain that {'falls' if slopes[steepest] < 0 else 'rises'} {abs(10 * slopes[steepest]):.1f} dB per 10 dB of level"
            f" around {knots[steepest] + SPACING_DB / 2:.0f} dBFS within {first(values, 'attack_ms'):.2g} ms, and comes back in"
            f" {first(values, 'release_ms'):.3g} ms"
            + (f"; it begins {ahead:.0f} ms before the sound that it acts on" if ahead else "")
        )


class _GainByLevel:
    """The gain of FreeGain on a stream, (n,) -> (n,): what it may hear ahead is in the same call, or not at all."""

    def __init__(self, values: Values) -> None:
        self._times = Times(
            first(values, "attack_ms"),
            first(values, "release_ms"),
            round(first(values, "ahead_ms")),
            first(values, "peak") > 0.5,
            first(values, "exponent"),
        )
        self._knots = _level_knots(first(values, "loudest_db"))
        self._gain_db = numbers(values, "gain_db", KNOTS)
        self._level_db, self._gain = FLOOR_DB, 10.0 ** (float(self._gain_db[0]) / 20.0)

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        if not x.size:
            return x
        level = _levels(np.pad(x, (0, -x.size % STEP)), [self._times], self._level_db)[0]
        self._level_db = float(level[-1])
        gains = np.append(self._gain, 10.0 ** (np.interp(level, self._knots, self._gain_db) / 20.0))
        self._gain = float(gains[-1])
        return (x * np.interp(np.arange(x.size) / STEP, np.arange(gains.size), gains)).astype(np.float32)


class FreeFilter(FreeLaw):
    """One more filter behind the path."""

    name = "free_filter"
    stage: ClassVar[Stage] = "path"
    family = "linear path"
    title = "a filter"
    parameters = (Parameter("taps", "1", 0.0, -10.0, 10.0),)  # of what is added, from LEAD before the voice itself on

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        return x + filtered(x, numbers(values, "taps"), LEAD if np.size(values["taps"]) > LEAD else 0)

    def fitted(self, ground: _Ground) -> Values:
        return {"taps": fit_filter(ground.heard, ground.target - ground.heard, ground.weights, TAPS, LEAD)}

    def drawn(self, values: Values) -> Drawn:
        hz, taps = np.geomspace(100.0, 7500.0, 60), numbers(values, "taps")
        waves = np.exp(-2j * np.pi * np.outer(hz, np.arange(taps.size) - LEAD) / SAMPLE_RATE)
        return "frequency", "Hz", hz, _gain_db(np.abs(1.0 + waves @ taps)), "dB"

    def sentence(self, values: Values) -> str:
        _, _, hz, gain_db, _ = self.drawn(values)
        high, low = int(np.argmax(gain_db)), int(np.argmin(gain_db))
        ms = 1000 * np.size(values["taps"]) // SAMPLE_RATE
        return (
            f"a filter of {ms} ms, {gain_db[high]:+.1f} dB at {hz[high]:.0f} Hz and {gain_db[low]:+.1f}"
            f" dB at {hz[low]:.0f} Hz"
        )


class FreeFilterAhead(FreeFilter):
    """One more filter ahead of a nonlinear loudspeaker, as of a player's equaliser; without a nonlinearity it is the same as one behind."""

    name = "free_filter_ahead"
    stage = "source"
    title = "a filter ahead of the loudspeaker"
    memory = AHEAD_TAPS

    def fitted(self, ground: _Ground) -> Values:
        """As if the rest were linear, whose filter is in proportion to it (Bussgang 1952), then by a Gauss-Newton step."""
        taps = fit_filter(ground.heard, ground.target - ground.heard, ground.weights, AHEAD_TAPS, LEAD)
        plain, louder = ground.heard, ground.part(2.0 * ground.x)
        if float(np.sum((louder - 2.0 * plain) ** 2)) > 1e-4 * float(np.sum(plain**2)):
            taps = _closer(ground, taps)
        return {"taps": taps}


def _closer(ground: _Ground, taps: Array) -> Array:
    """The taps of a filter ahead after a step towards the recording, halved as long as it leaves more; (taps,)."""
    part = loudest(ground.heard, ground.weights > 0.0, LEARNT_FROM)
    x, weights = ground.x[part], ground.weights[part].copy()
    weights[: SAMPLE_RATE // 2] = 0.0  # in it what was before is missing

    def heard(taps: Array) -> Samples:
        return ground.part(x + filtered(x, taps, LEAD))

    now, rows, played = heard(taps), np.empty((taps.size, x.size), np.float32), x + filtered(x, taps, LEAD)
    for row, late in zip(rows, at_lags(x, taps.size, LEAD).T, strict=True):
        row[:] = (ground.part(played + np.float32(NUDGE) * late) - now) * (weights / NUDGE)
    left = (ground.target[part] - now) * weights
    normal = (rows @ rows.T).astype(float)
    normal += (1e-4 * np.trace(normal) / taps.size + 1e-30) * np.eye(taps.size)
    step = np.linalg.solve(normal, (rows @ left).astype(float))
    tried = [taps + share * step for share in (1.0, 0.5, 0.25, 0.0)]
    return min(tried, key=lambda taps: float(np.sum(((ground.target[part] - heard(taps)) * weights) ** 2)))


class FreeModulation(FreeLaw):
    """A gain that moves with time by itself, again and again: a tremolo, blades in front of a loudspeaker, a contact that shakes."""

    name = "free_modulation"
    stage = "path"
    family = "modulation"
    title = "a gain that comes and goes"
    event = True
    parameters = (
        Parameter("rate_hz", "Hz", 1.0, 0.0, 8000.0),
        Parameter("mean", "1", 1.0, 0.0, 100.0),
        Parameter(
            "waves", "of mean", 0.0, -100.0, 100.0
        ),  # of the cosines of the rate and its multiples, then of the sines
    )
    run_note = "its phase is of this recording; the running filter follows it from there"

    def run(self, values: Values, sample_rate: int) -> Runner:
        return _Waves(values)

    def fitted(self, ground: _Ground) -> Values:
        energy, cross = ground.sums(STEP)
        rates, worth = _by_rate(energy, cross)
        if rates.size < 2:
            return {}

        def solved(rate: float) -> tuple[Array, float]:
            rows = np.concatenate((np.ones((1, energy.size)), _waves(rate, STEP * (np.arange(energy.size) + 0.5))))
            return _solved((rows * energy) @ rows.T, rows @ cross, 1e-3 * np.eye(len(rows))[1:])

        near = rates[int(np.argmax(worth))] + (rates[1] - rates[0]) * np.linspace(-1.0, 1.0, 41)
        rate = max(near, key=lambda rate: solved(rate)[1])
        found = solved(rate)[0]
        return {"rate_hz": rate, "mean": found[0], "waves": found[1:] / found[0]} if found[0] > 0.0 else {}

    def drawn(self, values: Values) -> Drawn:
        rate, waves = first(values, "rate_hz"), numbers(values, "waves", 2 * HARMONICS)
        time = np.linspace(0.0, 1.0 / rate, 65)
        return "time in a period", "s", time, _gain_db(1.0 + waves @ _waves(rate, time * SAMPLE_RATE)), "dB"

    def sentence(self, values: Values) -> str:
        *_, gain_db, _ = self.drawn(values)
        return f"a gain that moves between {gain_db.min():.1f} and {gain_db.max():+.1f} dB, {first(values, 'rate_hz'):.3g} times a second"


class _Waves:
    """The gain of FreeModulation on a stream, whose phase is another: it is followed there."""

    def __init__(self, values: Values) -> None:
        self._rate, self._mean = first(values, "rate_hz"), first(values, "mean")
        self._weights = numbers(values, "waves", 2 * HARMONICS)
        self._at, self._power = 0, 0.0

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        if heard is not None and not self._at:
            self._weights = 0.0 * self._weights
        moved = self._mean * x.astype(float) * _waves(self._rate, np.arange(float(self._at), float(self._at + x.size)))
        y = self._mean * x + self._weights @ moved
        self._at += x.size
        if heard is not None:
            self._power = max(0.95 * self._power, self._mean**2 * float(x @ x))
            self._weights = self._weights + 0.2 * (moved @ (heard - y)) / (self._power + 1e-9)
        return y.astype(np.float32)


class FreeLag(FreeLaw, Shift):
    """x(t - lag(t)), the lag a curve of time: a clock that is pulled, buffers that are filled again, a robot that moves."""

    name = "free_lag"
    title = "a lag that moves"
    event = True
    parameters = (Parameter("lag", "samples", 0.0, -1e5, 1e5),)  # a second from one to the next
    run_note = (
        "the running filter follows lags by itself, and this one was of this recording: adding it changes nothing there"
    )

    def read_at(self, values: Values, size: int, sample_rate: int) -> Array:
        n, lag = np.arange(size), numbers(values, "lag")
        return n - np.interp(n / sample_rate, np.arange(lag.size), lag)

    def fitted(self, ground: _Ground) -> Values:
        middle = LAG_STEP * (np.arange(ground.x.size // LAG_STEP) + 0.5) / SAMPLE_RATE
        parts = hats(middle, np.arange(2.0 + ground.x.size // SAMPLE_RATE))
        lag, bends = np.zeros(len(parts)), np.diff(np.eye(len(parts)), 2, axis=0)
        for _ in range(LAG_ROUNDS):
            moved = self.apply(ground.x, {**neutral(self), "lag": lag}, SAMPLE_RATE)
            slope, left = ground.part(np.gradient(moved).astype(np.float32)), ground.target - ground.part(moved)
            energy, cross = (block_sums(slope * other * ground.weights, LAG_STEP) for other in (slope, -left))
            lag = lag + _solved((parts * energy) @ parts.T, parts @ cross, bends)[0]
        return {"lag": lag[: ground.x.size // SAMPLE_RATE + 1]} if np.isfinite(lag).all() else {}

    def drawn(self, values: Values) -> Drawn:
        lag = numbers(values, "lag")
        return "time", "s", np.arange(float(lag.size)), lag, "samples"

    def sentence(self, values: Values) -> str:
        lag = numbers(values, "lag")
        return f"a lag that moves between {lag.min():+.2f} and {lag.max():+.2f} samples in the course of the recording"


class FreeCurveBehind(FreeCurve):
    """The same behind the path: a microphone, a converter."""

    name = "free_curve_behind"
    stage = "path"
    title = "a curve behind the path that each sample goes through"


class FreeGainBehind(FreeGain):
    """The same behind the path, by the level of the voice there."""

    name = "free_gain_behind"
    stage = "path"
    title = "a gain behind the path by level"


def _by_rate(energy: Array, cross: Array) -> tuple[Array, Array]:
    """Of each rate (k,) in Hz the energy that a gain 1 + a cos + b sin at it explains, (k,).

    From sums over each STEP of voice times voice, and voice times recording.
    """
    size = RATES_PER_CYCLE * energy.size
    per = SAMPLE_RATE / STEP / max(size, 1)
    own, other = np.fft.rfft(energy, size), np.fft.rfft(cross, size)
    rates = np.arange(max(round(RATES_HZ[0] / per), 1), min(round(RATES_HZ[1] / per), own.size // 2))
    at, twice, seen = own[rates], own[2 * rates], other[rates]
    even, odd, both = 0.5 * (own[0] + twice).real, 0.5 * (own[0] - twice).real, -0.5 * twice.imag
    whole = np.full(rates.size, own[0].real)
    rows = ((whole, at.real, -at.imag), (at.real, even, both), (-at.imag, both, odd))
    matrix = np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))
    right = np.stack((np.full(rates.size, other[0].real), seen.real, -seen.imag), axis=1)
    matrix += (1e-6 * own[0].real + 1e-30) * np.eye(3)
    found = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    return rates * per, np.sum(found * right, axis=1)


def _waves(rate_hz: float, samples: Array) -> Array:
    """Cosines, then sines, of a rate in Hz and its multiples at the sample numbers (n,), (2 HARMONICS, n)."""
    angle = 2.0 * np.pi * rate_hz / SAMPLE_RATE * samples * np.arange(1, HARMONICS + 1)[:, None]
    return np.concatenate((np.cos(angle), np.sin(angle)))


def _level_knots(loudest_db: float) -> Array:
    return loudest_db + SPACING_DB * np.arange(-KNOTS + 1.0, 1.0)


def _levels(x: Samples, settings: Sequence[Times], before_db: float = FLOOR_DB) -> Array:
    """Smoothed level, dB re full scale, at the end of each of the k steps of x (n,), for m Times, (m, k); before_db: ahead of x."""
    squares = blocks(x, STEP).astype(float) ** 2 + 10.0 ** (FLOOR_DB / 10.0)
    powers, steps = (squares.mean(axis=1), squares.max(axis=1)), np.arange(len(squares))
    levels = np.empty((len(settings), steps.size))
    for level, times in zip(levels, settings, strict=True):
        wanted = powers[times.peak][np.minimum(steps + times.ahead_ms, steps.size - 1)] ** times.exponent
        rising, falling = (-math.expm1(-1.0 / ms) for ms in (times.attack_ms, times.release_ms))
        now = 10.0 ** (before_db / 10.0 * times.exponent)
        # plain numbers: arrays of one cost ten times as much
        smoothed = [now := now + (rising if step > now else falling) * (step - now) for step in wanted.tolist()]
        level[:] = 10.0 * np.log10(smoothed) / times.exponent
    return levels


def _solved(matrix: Array, right: Array, bends: Array) -> tuple[Array, float]:
    """Regularised least squares: weights (k,) with a penalty on `bends @ weights`, bends (m, k), and the energy that they explain."""
    held = (BEND * bends.T @ bends + 1e-6 * BEND * np.eye(right.size)) * (np.trace(matrix) / right.size + 1e-30)
    found = np.linalg.solve(matrix + held, right)
    return found, float(2.0 * found @ right - found @ matrix @ found)


def _gain_db(gain: Array) -> Array:
    return 20.0 * np.log10(np.maximum(gain, 1e-2))
