"""Families with free laws, for what no listed effect explains: a curve, a gain by level or by time, a filter, a lag; as one's own effect."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Literal, TypeAlias

import numpy as np

from edgefilter.diagnosis.closer_look import BEAT, Curve, by_rate
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.score import Scorer, share_of
from edgefilter.diagnosis.trials import Found
from edgefilter.dsp.frames import block_power, block_sums, blocks, decibels
from edgefilter.echo.evidence import Score
from edgefilter.echo.least_squares import normal_equations
from edgefilter.echo.model import EchoModel
from edgefilter.echo.wiener import fit_filter
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

SHARES = np.array([0.03, 0.06, 0.1, 0.16, 0.24, 0.35, 0.5, 0.7, 1.0])
"""Knots of a curve to either side, re the highest sample: closer where speech has most of its samples."""
STEP = 16
"""Samples (1 ms) from one value of the level to the next."""
KNOTS, SPACING_DB = 11, 5.0
"""Of the gain over the level, down from the loudest: below lies what the fan hides."""
ATTACKS_MS, RELEASES_MS = (0.5, 3.0, 15.0, 60.0, 300.0), (10.0, 40.0, 150.0, 600.0, 2000.0)
AHEAD_MS = (0, 1, 2, 4, 8)
"""By which the level is heard before the sound that it acts on: a limiter that holds the sound back for so long."""
LEVELS = {"mean": 6.0, "max": 15.0}
"""What a step counts by, the mean square or the peak's, and dB over the loudest 20 ms that it may reach."""
FINER = (2.0, 1.4)
"""Ratios of times that are tried next on either side of the best."""
Setting: TypeAlias = tuple[float, float, int, str]
"""Of a level: attack and release in ms, by how many ms it is heard ahead, and what a step counts by."""
BEND = 1e-4
"""Weight of a curve's second differences, re the voice's mean energy at a knot: where speech hardly comes it goes on as beside it."""
RATES_HZ = (0.5, 150.0)
"""Slower is a drift of the gain; faster is heard as a tone of its own."""
HARMONICS = 4
TAPS, LEAD = 256, 32
"""Of the filter: an echo of 14 ms; longer ones are listed."""
LAG_STEP = 1600
"""Samples (100 ms) in which a lag is one number; its curve has a knot a second, so that blocks of half a second that no fit has used
lie between two."""
LAG_ROUNDS = 6
"""Newton steps: each halves at least what is left of a lag of some samples."""
FILE = '''"""{title}, as `edgefilter diagnose` found it: {words}."""

import numpy as np

from edgefilter import Effect, Parameter

{code}


class {class_name}(Effect):
    """{title}: with amount 1 the law above, with 0 the voice as it is."""

    name = "{name}"
    family = "{family}"
    stage = "{stage}"{more}
    parameters = (Parameter("amount", "1", 0.0, 0.0, 2.0),)

    def apply(self, x, values, sample_rate):
        return (x + values["amount"] * (Law()(x) - x)).astype(np.float32)

    def run(self, values, sample_rate):  # on a stream, where the law goes on from hop to hop
        law, amount = Law(), values["amount"]
        return lambda x, heard=None: (x + amount * (law(x, heard) - x)).astype(np.float32)

    def fit(self, measurement, model):
        x = measurement.reference
        plain = model.predict(x)
        changed = {changed}
        change, left = (measurement.whiten(y.astype(np.float32)) for y in (changed - plain, measurement.recording - plain))
        used = measurement.weights * change
        return {{"amount": float(np.clip(np.sum(used * left) / (np.sum(used * change) + 1e-30), 0.0, 2.0))}}
'''
STATIC = """INPUT = {input}
OUTPUT = {output}  # full scale; beyond the last ones the curve goes on as it ends


class Law:
    def __call__(self, x, heard=None):
        return np.interp(x, INPUT, OUTPUT)"""
DYNAMICS = """LEVEL_DB = {level}
GAIN_DB = {gain}
ATTACK_MS, RELEASE_MS, AHEAD_MS = {attack:.3g}, {release:.3g}, {ahead}


class Law:
    def __init__(self):
        self.power, self.gain = 0.0, 10 ** (GAIN_DB[0] / 20)

    def __call__(self, x, heard=None):
        gains = [self.gain]
        powers = np.{of}(np.pad(x, (0, -x.size % {step})).reshape(-1, {step}).astype(float) ** 2, axis=1)
        for power in powers[np.minimum(np.arange(powers.size) + AHEAD_MS, powers.size - 1)]:
            ms = ATTACK_MS if power > self.power else RELEASE_MS
            self.power += (1 - np.exp(-1 / ms)) * (power - self.power)
            gains.append(10 ** (np.interp(10 * np.log10(self.power + 1e-12), LEVEL_DB, GAIN_DB) / 20))
        self.gain = gains[-1]
        return x * np.interp(np.arange(x.size) / {step}, np.arange(len(gains)), gains)"""
MODULATION = """RATE_HZ, MEAN = {rate:.6f}, {mean:.4f}
WAVES = {waves}  # of the cosines of the rate and its multiples, then of the sines


class Law:
    def __init__(self):
        self.at, self.waves, self.power = 0, WAVES, 0.0

    def __call__(self, x, heard=None):
        angle = 2 * np.pi * RATE_HZ / 16000 * np.arange(self.at, self.at + x.size) * np.arange(1, {count})[:, None]
        moved = MEAN * x * np.concatenate((np.cos(angle), np.sin(angle)))
        if heard is not None and self.at == 0:  # a stream, whose phase is another: followed from here on
            self.waves = 0 * WAVES
        y = MEAN * x + self.waves @ moved
        self.at += x.size
        if heard is not None:
            self.power = max(0.95 * self.power, MEAN**2 * float(x @ x))
            self.waves = self.waves + 0.2 * (moved @ (heard - y)) / (self.power + 1e-9)
        return y"""
FILTER = """TAPS = {taps}
LEAD = {lead}  # taps before the voice itself


class Law:
    def __call__(self, x, heard=None):
        return np.convolve(x, TAPS)[LEAD:][: x.size] if x.size else x"""

LAG = """from scipy.ndimage import map_coordinates

LAG = {lag}  # samples, a second from one to the next


class Law:
    def __call__(self, x, heard=None):
        if heard is not None:  # a stream: the running filter follows a lag by itself
            return x
        n = np.arange(x.size)
        return map_coordinates(x, [n - np.interp(n / 16000, np.arange(LAG.size), LAG)], order=5, mode="nearest")"""


@dataclass(frozen=True, eq=False)
class Law:
    """The best law of a family: what it is, in words and drawn, and its lines of Python, which define a class Law.

    beside: names of the listed effects that it stands beside. gain_db: by which it lowers the held-out level beside them;
    excess_db: what is left then, as of any comparison.
    """

    family: str
    words: str
    stage: Literal["source", "path"]
    curve: Curve
    code: str
    event: bool = False
    beside: tuple[str, ...] = ()
    gain_db: float = 0.0
    excess_db: float = 0.0
    prediction: Samples = field(default_factory=lambda: np.zeros(0, np.float32), repr=False)

    def __call__(self, x: Samples) -> Samples:
        """What the law makes of x (n,), (n,): by its lines, so that what is scored is what is written."""
        return _run(self.code, x)

    def predict(self, model: EchoModel, reference: Samples) -> Samples:
        """What a model with the law predicts for an aligned reference (n,), (n,)."""
        return model.predict(self(reference)) if self.stage == "source" else self(model.predict(reference))

    def file(self, name: str) -> str:
        """The text of a Python file that defines an effect of that name."""
        of_recording = (
            '\n    event = True\n    run_note = "it is of this recording; the running filter follows it by itself"'
        )
        return FILE.format(
            family=self.family,
            title=f"{self.family[:1].upper()}{self.family[1:]}",
            words=self.words,
            code=self.code,
            name=name,
            class_name=name.title().replace("_", ""),
            stage=self.stage,
            more=of_recording if self.event else "",
            changed="model.predict(Law()(x).astype(np.float32))" if self.stage == "source" else "Law()(plain)",
        )

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {
            "family": self.family,
            "words": self.words,
            "beside": list(self.beside),
            "gain_db": round(self.gain_db, 3),
            "excess_db": round(self.excess_db, 3),
            "curve": self.curve.to_dict(),
        }


def _run(code: str, x: Samples) -> Samples:
    """What a law's lines make of x (n,), (n,)."""
    known: dict[str, Any] = {"np": np}
    exec(code, known)
    return np.asarray(known["Law"]()(x), np.float32)


def free_law(found: Found, criteria: Criteria, progress: Callable[[str], None] | None = None) -> Law | None:
    """The law that explains most of what a search leaves, or of all that the profile does; None where what is named explains nearly as much."""
    scorer = Scorer(found.prepared)
    base = scorer.of(found.start)
    named = tuple(step.name for step in found.steps)
    starts = [(found.start, ()), (found.model, named)] if named else [(found.start, ())]
    tried = [each for model, names in starts for each in _laws(scorer, model, names, progress)]
    law, score = max(tried, key=lambda each: -each[1].level_db, default=(None, base))
    most_db = base.level_db - score.level_db
    little = most_db < criteria.part_level * (base.over_db - base.floor_db)
    if law is None or little or share_of(base.excess_db, score.excess_db) < criteria.half:
        return None
    return law if base.level_db - found.final.level_db < criteria.nearly * most_db else None


def _laws(
    scorer: Scorer, model: EchoModel, names: tuple[str, ...], progress: Callable[[str], None] | None
) -> Iterator[tuple[Law, Score]]:
    """The best law of each family beside a model, with its score on samples that its fit has not used."""
    before = scorer.of(model)
    for family, stages in STAGES.items():
        for stage in stages:
            if progress:
                progress(f"trying {family.__name__.replace('_', ' ')}")
            ground = _Ground(scorer.behind(model), model, stage)
            law = family(ground) if ground.sounds else None
            if law is None:
                continue
            prediction = law.predict(model, scorer.measurement.reference)
            score = scorer.of(model, prediction)
            told = {"beside": names, "gain_db": before.level_db - score.level_db, "excess_db": score.excess_db}
            yield Law(**{**vars(law), **told, "prediction": score.prediction}), score


class _Ground:
    """What a law is fitted to: x (n,) that it acts on at its stage, heard (n,) whitened at the microphone, the recording, what counts."""

    def __init__(self, scorer: Scorer, model: EchoModel, stage: Literal["source", "path"]) -> None:
        self.stage = stage
        self._measurement, self._model = scorer.measurement, model
        plain, self.heard = self._measurement.predicted(model)
        self.x = self._measurement.reference if stage == "source" else plain
        self.target, self.weights = self._measurement.white_recording, self._measurement.weights
        self.lag = PRE_ROLL if stage == "source" else 0

    @property
    def sounds(self) -> bool:
        """Whether any of the voice is in the samples that a law is fitted to."""
        return bool((self.x * self.weights).any())

    def part(self, x: Samples) -> Samples:
        """What a part (n,) of x becomes at the microphone, whitened."""
        return self._measurement.whiten(self._model.predict(x) if self.stage == "source" else x)

    def solve(self, parts: list[Samples], bends: Array) -> Array:
        """Least-squares weights of x's parts (k, n), their bends (m, k) held small; (k,)."""
        normal = normal_equations([self.part(part) for part in parts], self.target, 1, 0, self.weights > 0.0)
        return _solved(normal.matrix, normal.right, bends)[0]


def static_curve(ground: _Ground) -> Law:
    """f(x), f straight between its knots, f(0) = 0: an amplifier, a valve, a rectifier, a converter."""
    peak = float(np.max(np.abs(ground.x * (ground.weights > 0.0))))
    knots = peak * np.concatenate((-SHARES[::-1], [0.0], SHARES))
    parts = _hats(ground.x, knots, beyond=True)
    slopes = np.diff(np.eye(knots.size), axis=0) / np.diff(knots)[:, None]
    bends = np.delete(np.diff(slopes, axis=0), SHARES.size, axis=1)
    bends *= 1.0 / np.sqrt(np.trace(bends.T @ bends) / bends.shape[1])
    heights = np.insert(ground.solve(list(np.delete(parts, SHARES.size, axis=0)), bends), SHARES.size, 0.0)
    gain = heights / np.where(knots == 0.0, 1.0, knots)
    middle = 0.5 * (gain[SHARES.size - 1] + gain[SHARES.size + 1]) or 1.0
    gain_db = 20.0 * np.log10(np.maximum(np.delete(gain / middle, SHARES.size), 1e-2))
    beyond = [end + 3.0 * peak * (end - near) / span for end, near, span in
              ((heights[0], heights[1], 0.3 * peak), (heights[-1], heights[-2], 0.3 * peak))]  # fmt: skip
    code = STATIC.format(
        input=_array([-4.0 * peak, *knots, 4.0 * peak], 4), output=_array([beyond[0], *heights, beyond[1]], 4)
    )
    words = (
        f"each sample goes through one curve, which gives {gain_db[-1]:+.1f} dB at its upper end and {gain_db[0]:+.1f} dB at"
        " its lower end of what it gives in its middle"
    )
    curve = Curve.of("the sample's value", "of full scale", np.delete(knots, SHARES.size), gain_db, 1.0)
    return Law("static nonlinearity", words, ground.stage, curve, code)


def dynamics(ground: _Ground) -> Law:
    """g(L) x, L the level of x, its power smoothed with an attack and a release: compressor, limiter, expander, gate, normaliser."""
    loud_db = float(decibels(np.max(block_power(ground.x, SAMPLE_RATE // 50))))
    knots = {of: np.ceil(loud_db) + over + SPACING_DB * np.arange(-KNOTS + 1.0, 1.0) for of, over in LEVELS.items()}
    bends = np.concatenate((np.diff(np.eye(KNOTS), 2, axis=0), 0.1 * np.diff(np.eye(KNOTS), axis=0)))
    energy, cross = (
        block_sums(np.roll(ground.heard * other * ground.weights, -ground.lag), STEP)
        for other in (ground.heard, ground.target)
    )

    def best(settings: list[Setting]) -> Setting:
        def worth(level: Array, of: str) -> float:
            hats = _hats(level, knots[of])
            return _solved((hats * energy) @ hats.T, hats @ cross, bends)[1]

        levels = _levels(ground.x, settings)
        return settings[int(np.argmax([worth(level, of) for level, (*_, of) in zip(levels, settings, strict=True)]))]

    def refined(ahead: int, of: str) -> Setting:
        attack, release, *_ = best(list(product(ATTACKS_MS, RELEASES_MS, (ahead,), (of,))))
        for ratio in FINER:
            around = (1.0 / ratio, 1.0, ratio)
            attack, release, *_ = best([(attack * a, release * r, ahead, of) for a, r in product(around, around)])
        return attack, release, ahead, of

    plain = refined(0, "mean")
    _, _, ahead, of = best([(*plain[:2], ahead, of) for ahead, of in product(AHEAD_MS, LEVELS)])
    attack, release, ahead, of = best([plain, refined(ahead, of)])
    level, knots = _levels(ground.x, [(attack, release, ahead, of)])[0], knots[of]
    drawn = np.interp(np.arange(ground.x.size) / STEP, np.arange(level.size + 1), np.concatenate((level[:1], level)))
    gain = ground.solve([ground.x * hat.astype(np.float32) for hat in _hats(drawn, knots)], bends)
    gain_db = np.clip(20.0 * np.log10(np.maximum(gain, 1e-3)), -40.0, 40.0)
    usual, loudest = np.quantile(level, (0.5, 0.99))
    reached = knots > usual - SPACING_DB
    slopes = np.diff(gain_db) / SPACING_DB * reached[1:] * (knots[1:] < loudest + SPACING_DB)
    steepest = int(np.argmax(np.abs(slopes)))
    words = (
        f"a gain that {'falls' if slopes[steepest] < 0 else 'rises'} {abs(10 * slopes[steepest]):.1f} dB per 10 dB of level"
        f" around {knots[steepest] + SPACING_DB / 2:.0f} dBFS within {attack:.2g} ms, and comes back in {release:.3g} ms"
        + (f"; it begins {ahead} ms before the sound that it acts on" if ahead else "")
    )
    curve = Curve.of("level", "dBFS", knots[reached], gain_db[reached], 1.0)
    times = {"attack": attack, "release": release, "ahead": ahead, "of": of, "step": STEP}
    code = DYNAMICS.format(level=_array(knots, 1), gain=_array(gain_db, 2), **times)
    return Law("dynamics", words, ground.stage, curve, code)


def modulation(ground: _Ground) -> Law | None:
    """A gain that moves with time by itself, again and again: a tremolo, blades in front of a loudspeaker, a contact that shakes."""
    energy, cross = (block_sums(ground.heard * other * ground.weights, BEAT) for other in (ground.heard, ground.target))
    rates, worth, _ = by_rate(energy, cross, *RATES_HZ)
    most = float(rates[int(np.argmax(worth))])
    orders = np.arange(1, HARMONICS + 1)[:, None]

    def waves(angle: Array) -> Array:
        return np.concatenate((np.ones((1, angle.size)), np.cos(orders * angle), np.sin(orders * angle)))

    def solved(rate: float) -> tuple[Array, float]:
        rows = waves(2.0 * np.pi * rate * BEAT / SAMPLE_RATE * (np.arange(energy.size) + 0.5))
        return _solved((rows * energy) @ rows.T, rows @ cross, 1e-3 * np.eye(len(rows))[1:])

    rate = max(most + (rates[1] - rates[0]) * np.linspace(-1.0, 1.0, 41), key=lambda near: solved(near)[1])
    found, _ = solved(rate)
    if found[0] <= 0.0:
        return None
    gain_db = 20.0 * np.log10(np.maximum(found @ waves(np.linspace(0.0, 2.0 * np.pi, 65)) / found[0], 1e-2))
    words = f"a gain that moves between {gain_db.min():.1f} and {gain_db.max():+.1f} dB, {rate:.3g} times a second"
    curve = Curve.of("time in a period", "s", np.linspace(0.0, 1.0 / rate, 65), gain_db, 1.0)
    code = MODULATION.format(rate=rate, mean=found[0], waves=_array(found[1:] / found[0], 4), count=HARMONICS + 1)
    return Law("modulation", words, ground.stage, curve, code, event=True)


def linear_path(ground: _Ground) -> Law:
    """One more filter behind the path."""
    taps = fit_filter(ground.heard, ground.target, ground.weights, TAPS, LEAD)
    hz = np.geomspace(100.0, 7500.0, 60)
    response = np.abs(np.exp(-2j * np.pi * np.outer(hz, np.arange(TAPS)) / SAMPLE_RATE) @ taps)
    gain_db = 20.0 * np.log10(np.maximum(response, 1e-2))
    high, low = int(np.argmax(gain_db)), int(np.argmin(gain_db))
    words = (
        f"a filter of {TAPS // (SAMPLE_RATE // 1000)} ms, {gain_db[high]:+.1f} dB at {hz[high]:.0f} Hz and {gain_db[low]:+.1f} dB at"
        f" {hz[low]:.0f} Hz"
    )
    curve = Curve.of("frequency", "Hz", hz, gain_db, 1.0)
    return Law("linear path", words, ground.stage, curve, FILTER.format(taps=_array(taps, 4), lead=LEAD))


def wander(ground: _Ground) -> Law | None:
    """x(t - lag(t)), the lag a curve of time: a clock that is pulled, buffers that are filled again, a robot that moves."""
    middle = LAG_STEP * (np.arange(ground.x.size // LAG_STEP) + 0.5) / SAMPLE_RATE
    hats = _hats(middle, np.arange(2.0 + ground.x.size // SAMPLE_RATE))
    lag, bends = np.zeros(len(hats)), np.diff(np.eye(len(hats)), 2, axis=0)
    for _ in range(LAG_ROUNDS):
        moved = _run(LAG.format(lag=_array(lag, 4)), ground.x)
        slope, left = ground.part(np.gradient(moved).astype(np.float32)), ground.target - ground.part(moved)
        energy, cross = (block_sums(slope * other * ground.weights, LAG_STEP) for other in (slope, -left))
        lag += _solved((hats * energy) @ hats.T, hats @ cross, bends)[0]
    if not np.isfinite(lag).all():
        return None
    heard = lag[: ground.x.size // SAMPLE_RATE + 1]  # the last knot may lie behind the end
    words = f"a lag that moves between {heard.min():+.2f} and {heard.max():+.2f} samples in the course of the recording"
    curve = Curve.of("time", "s", np.arange(float(heard.size)), heard, 1.0, "samples")
    return Law("time", words, ground.stage, curve, LAG.format(lag=_array(lag, 4)), event=True)


STAGES: dict[Callable[[_Ground], Law | None], tuple[Literal["source", "path"], ...]] = {
    static_curve: ("source", "path"),
    dynamics: ("source", "path"),
    modulation: ("path",),
    linear_path: ("path",),
    wander: ("path",),
}
"""The families, and where each may stand: ahead of the path, or behind it."""


def _levels(x: Samples, settings: list[Setting]) -> Array:
    """Level in dB at the end of each step of x (n,), by m settings, (m, k)."""
    attacks, releases, *_ = zip(*settings, strict=True)
    rising, falling = (-np.expm1(-1.0 / np.array(ms)) for ms in (attacks, releases))
    squares = blocks(x, STEP).astype(float) ** 2
    powers = {"mean": squares.mean(axis=1), "max": squares.max(axis=1)}
    last, steps = len(squares) - 1, np.arange(len(squares))
    wanted = np.stack([powers[of][np.minimum(steps + ahead, last)] for *_, ahead, of in settings], axis=1)
    level, now = np.empty(wanted.shape), np.zeros(len(settings))
    for row, asked in zip(level, wanted, strict=True):
        step = asked - now
        now = now + np.where(step > 0.0, rising, falling) * step
        row[:] = now
    return 10.0 * np.log10(level.T + 1e-12)


def _hats(x: Array, knots: Array, beyond: bool = False) -> Array:
    """Parts whose sum by heights at the knots (k,) is the curve through these at x (n,), (k, n) float32.

    beyond: whether it goes on as it ends outside of the knots, rather than level.
    """
    left = np.clip(np.searchsorted(knots, x) - 1, 0, knots.size - 2)
    share = ((x - knots[left]) / (knots[left + 1] - knots[left])).astype(np.float32)
    share = share if beyond else np.clip(share, 0.0, 1.0)
    hats = np.zeros((knots.size, x.size), np.float32)
    at = np.arange(x.size)
    hats[left, at], hats[left + 1, at] = 1.0 - share, share
    return hats


def _solved(matrix: Array, right: Array, bends: Array) -> tuple[Array, float]:
    """Least-squares weights (k,), their bends (m, k) held small, and the energy that they explain."""
    held = (BEND * bends.T @ bends + 1e-6 * BEND * np.eye(right.size)) * (np.trace(matrix) / right.size + 1e-30)
    found = np.linalg.solve(matrix + held, right)
    return found, float(2.0 * found @ right - found @ matrix @ found)


def _array(numbers: Array | list[float], digits: int) -> str:
    """Python for an array (k,) rounded to so many digits behind the point."""
    return f"np.array({np.round(np.ravel(numbers), digits).tolist()})"
