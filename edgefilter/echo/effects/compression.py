"""A player or amplifier that turns loud passages down."""

from __future__ import annotations

from itertools import product

import numpy as np
import scipy

from edgefilter.dsp.frames import amplitude, decibels
from edgefilter.echo.effect import Effect, Parameter, Runner, first, within
from edgefilter.echo.effects.gain_fit import Reach, fit_one
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import Array, Samples

STARTS = tuple(product((1.0, -3.0, -8.0, -15.0), (0.2, 0.6), np.log([8.0]), np.log([60.0, 300.0])))
"""Thresholds in dB re the loudest 20 ms of the reference, slopes in dB per dB, logarithms of attack and release in ms to start from."""
STEEPEST = 0.98
"""Slope, dB per dB: a ratio of 50 to 1 lets no more through than a limiter does."""
REACH = Reach(
    nudge=np.array([0.5, 0.03, 0.15, 0.15]),
    lowest=np.array([-80.0, 0.0, np.log(0.3), np.log(5.0)]),
    highest=np.array([0.0, STEEPEST, np.log(200.0), np.log(5000.0)]),
)
"""Of threshold in dB, slope in dB per dB, attack and release as natural logarithms of ms."""


class Compression(Effect):
    """Feed-forward compressor: above threshold the level rises by 1 / ratio dB per dB, over a knee, then make-up gain.

    After Giannoulis, Massberg & Reiss 2012, "Digital dynamic range compressor design": the level is the mean square
    over the attack time, in dB; the gain computer with a soft knee (their eq. 4) asks for a reduction; that rises at
    once and falls exponentially with the release time, as in their decoupled peak detector (eq. 17).
    """

    name = "compression"
    stage = "source"
    family = "dynamics"
    title = "compression"
    complexity = 2
    flexible = True
    parameters = (
        Parameter("threshold_db", "dB re full scale", -20.0, -80.0, 0.0),
        Parameter("ratio", "dB/dB", 1.0, 1.0, 50.0),
        Parameter("attack_ms", "ms", 10.0, 0.1, 1000.0),
        Parameter("release_ms", "ms", 200.0, 1.0, 5000.0),
        Parameter("knee_db", "dB", 6.0, 0.0, 30.0),
        Parameter("makeup_db", "dB", 0.0, -40.0, 40.0),
    )

    def run(self, values: Values, sample_rate: int) -> Runner:
        return Compressor(values, sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """From the best of a grid of thresholds, slopes and releases (gain_fit)."""
        return fit_one(self, measurement, model, self._values, REACH, STARTS)

    def _values(self, unknowns: Array) -> Values:
        threshold_db, slope, attack, release = unknowns
        times = {"attack_ms": np.exp(attack), "release_ms": np.exp(release)}
        return within(self, {"threshold_db": threshold_db, "ratio": 1.0 / (1.0 - slope), **times})

    def sentence(self, values: Values) -> str:
        return (
            f"the voice is turned down when it has been loud: above {first(values, 'threshold_db'):.0f} dB "
            f"by {first(values, 'ratio'):.1f} to 1, while the fan is as loud as ever"
        )


class Compressor:
    """One compressor on a stream, (n,) -> (n,): values as of Compression."""

    def __init__(self, values: Values, sample_rate: int) -> None:
        self._slope, self._makeup = 1.0 - 1.0 / float(values["ratio"]), float(values["makeup_db"])
        self._threshold, self._knee = float(values["threshold_db"]), float(values["knee_db"])
        self._keep = np.exp(-1.0 / (float(values["attack_ms"]) * 1e-3 * sample_rate))
        self._release = float(values["release_ms"]) * 1e-3 * sample_rate
        self._level, self._held = np.zeros(1), 0.0

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        if self._slope == 0.0:
            return x * np.float32(10.0 ** (self._makeup / 20.0))
        square = np.square(x, dtype=np.float64)
        power, self._level = scipy.signal.lfilter([1.0 - self._keep], [1.0, -self._keep], square, zi=self._level)
        over, knee = decibels(power.astype(np.float32)) - self._threshold, self._knee
        bent = np.clip(over + knee / 2, 0.0, knee) ** 2 / (2 * knee) if knee > 0.0 else 0.0
        held = falling_peak(bent + np.maximum(over - knee / 2, 0.0), self._release, self._held)
        self._held = float(held[-1]) if held.size else self._held
        return (x * amplitude(self._makeup - self._slope * held)).astype(np.float32)


def falling_peak(x: Array, samples: float, before: float) -> Array:
    """y(n) = max(x(n), y(n - 1) e^(-1 / samples)) for x >= 0, as a running maximum of ln x + n / samples; before is y(-1)."""
    rise = np.arange(x.size) / samples
    level = np.log(x + 1e-12) + rise
    if before > 0.0 and level.size:
        level[0] = max(float(level[0]), float(np.log(before)) - 1.0 / samples)
    return np.exp(np.maximum.accumulate(level) - rise)
