"""An automatic gain control at the microphone: the gain of voice and fan alike drifts with time."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.frames import block_power, block_sums, blocks
from edgefilter.echo.effect import Effect, Family, Parameter, Runner, Stage
from edgefilter.echo.effects.gain_law import STEP, follow
from edgefilter.echo.evidence import Evidence
from edgefilter.echo.least_squares import absorbed
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

KNOTS_HZ = 4.0
"""Knots per second of a gain curve that follows no law."""
BEND = 0.01
"""Standard deviation of the change of slope of the gain from knot to knot that is expected, relative to the gain."""
BENDS = 0.5
"""Of the mean square of the gain's movement, a law must leave less than this to be followed."""
LEAST_RANGE_DB = 0.4
"""A gain that moves by less stands still."""
FAN_ALONE = 1.6
"""Times the fan's power up to which a step of 25 ms may show nothing else."""
PERCENTILES = 3.29
"""Standard deviations from the 5th to the 95th percentile."""
FASTEST_S = 0.05
CORRELATED = 16.0
"""By how much more the samples of a voice vary together than those of white noise."""
LEFT_MEMORY = 0.2
"""Share of a hop in the energy that the gain leaves."""
FRAME = SAMPLE_RATE // 8
SILENT = 0.1
"""A frame shows the fan alone where the predicted voice has less than this part of its power."""
FAN_TRUST = 0.25
"""Weight of a silent frame relative to what white noise would deserve: the fan itself is only known to some tenths of a
dB."""


class MicAgc(Effect):
    """y(t) = g(t) x(t), g in dB piecewise linear between its knots.

    What the microphone hears of the fan gets the same gain.

    gain_db: (k,) at 0, 1 / knots_hz, 2 / knots_hz ..., the last one held, or one number. range_db and time_constant_s
    only report: the spread of the gain between its 5th and 95th percentile, and the lag at which the gain's
    autocovariance has fallen to 1/e.
    """

    name: ClassVar[str] = "mic_agc"
    stage: ClassVar[Stage] = "microphone"
    family: ClassVar[Family] = "dynamics"
    title: ClassVar[str] = "a microphone gain control"
    run_note: ClassVar[str] = (
        "its curve is of this recording; the running filter follows the gain by itself, as far and as fast as here"
    )
    event: ClassVar[bool] = True
    complexity: ClassVar[int] = 1
    flexible: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("gain_db", "dB", 0.0, -60.0, 60.0),
        Parameter("knots_hz", "1/s", KNOTS_HZ, 0.01, 1000.0),
        Parameter("range_db", "dB", 0.0, 0.0, 120.0),
        Parameter("time_constant_s", "s", 0.0, 0.0, 1e4),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Return x (n,) times the gain of each moment."""
        knots = np.atleast_1d(np.asarray(values["gain_db"], float))
        if not knots.any():
            return x.copy()
        position = np.arange(x.size) * (float(values["knots_hz"]) / sample_rate)
        return (x * 10.0 ** (np.interp(position, np.arange(knots.size), knots) / 20.0)).astype(np.float32)

    def run(self, values: Values, sample_rate: int) -> Runner | None:
        """A follower of the gain, as far and as fast as it moved in the recording; none where it stood still."""
        spread = float(values["range_db"])
        if spread < LEAST_RANGE_DB:
            return None
        middle = 10.0 ** (float(np.median(np.asarray(values["gain_db"], float))) / 20.0)
        return GainFollower(middle, spread, float(values["time_constant_s"]), sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """A law by which the gain follows the level, where there is one, and what differs from it slowly.

        The latter by penalised least squares of the gain at the knots: from the voice where it sounds, from the fan's
        power where it does not. It is a smoothing spline of first order (Eilers & Marx 1996, with second differences),
        which bridges what is not fitted.
        """
        heard, predicted = measurement.heard(model)
        recording = measurement.white_recording
        voice = absorbed(predicted, recording, measurement.fit)
        energy = float(np.dot(predicted, predicted))
        overall = float(np.dot(voice, predicted)) / energy if energy > 0.0 else 1.0
        overall = overall if overall > 1e-3 else 1.0
        law = _law(heard, voice, recording, measurement)
        matrix, right = _from_voice(voice * law, recording, measurement)
        if measurement.noise_psd is not None:
            for_fan, wanted = _from_fan(voice, recording, measurement, overall, law)
            matrix[1] += for_fan
            right += wanted
        gain = law * _at_samples(_smooth(matrix, right), law.size)
        if not _pays(gain, voice, recording, measurement):
            return {
                "gain_db": float(np.clip(20.0 * np.log10(overall), -60.0, 60.0)),
                "range_db": 0.0,
                "time_constant_s": 0.0,
            }
        step = int(SAMPLE_RATE / KNOTS_HZ) if np.all(law == 1.0) else STEP
        curve = 20.0 * np.log10(np.clip(np.append(gain, gain[-1:])[::step] * overall, 1e-3, 1e3))
        low, high = np.percentile(curve, [5, 95])
        knots_hz = SAMPLE_RATE / step
        return {
            "gain_db": curve,
            "knots_hz": knots_hz,
            "range_db": float(high - low),
            "time_constant_s": _time_constant(curve, knots_hz),
        }

    def sentence(self, values: Values) -> str:
        """What tells it from a player's control."""
        return "voice and fan rise and fall together with a slow gain"

    def plausible(self, evidence: Evidence) -> bool:
        """Whether the fan moves with the gain, as it does behind a microphone's control and does not behind a player's.

        By the likelihood of the residual's power in steps where little but the fan is left, its level constant or times
        the gain's square.
        """
        if float(evidence.values["range_db"]) < LEAST_RANGE_DB:
            return False
        measurement = evidence.grid.measurement
        gain = self.apply(np.ones_like(measurement.recording), evidence.values, SAMPLE_RATE)
        white = measurement.whiten(measurement.recording - evidence.after.prediction).astype(np.float64) ** 2
        square, power = (block_sums(x, STEP) / STEP for x in (gain.astype(np.float64) ** 2, white))
        low = (power < FAN_ALONE * square) & (block_sums(evidence.grid.usable, STEP) == STEP)
        if low.sum() < 20:
            return False
        moving, still = (
            np.log(np.mean(power[low] / square[low])) + np.mean(np.log(square[low])),
            np.log(np.mean(power[low])),
        )
        return bool(moving < still)


class GainFollower:
    """Puts the gain of the moment on the predicted voice: a scalar Kalman filter on what the microphone heard of it.

    The gain is taken to move around its middle as a first-order Markov process does whose 5th and 95th percentile are
    range_db apart and whose autocovariance falls to 1/e in time_constant_s. A hop tells it with the variance of what
    the gain leaves unexplained over the voice's energy, times CORRELATED: a voice's samples are not independent.
    """

    def __init__(self, middle: float, range_db: float, time_constant_s: float, sample_rate: int) -> None:
        self._middle, self._rate = middle, sample_rate
        self._variance = (middle * np.log(10.0) / 20.0 * range_db / PERCENTILES) ** 2
        self._time_constant = max(time_constant_s, FASTEST_S)
        self._gain, self._doubt, self._left = middle, self._variance, 0.0

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        """Return x (n,) times the gain, which runs from its last value to what heard (n,) makes of it."""
        assert heard is not None, "a gain behind the path is followed by what the microphone hears"
        before = self._gain
        kept = float(np.exp(-x.size / (self._time_constant * self._rate)))
        self._gain = self._middle + kept * (self._gain - self._middle)
        self._doubt = kept**2 * self._doubt + (1.0 - kept**2) * self._variance
        energy = float(x.dot(x))
        rest = heard - np.float32(self._gain) * x
        self._left += LEFT_MEMORY * (float(rest.dot(rest)) - self._left)
        if energy > 0.0:
            trust = self._doubt / (self._doubt + CORRELATED * self._left / x.size / energy + 1e-12)
            self._gain += trust * float(rest.dot(x)) / energy
            self._doubt *= 1.0 - trust
        return x * np.linspace(before, self._gain, x.size + 1, dtype=np.float32)[1:]


def _law(heard: Samples, voice: Samples, recording: Samples, measurement: Measurement) -> Samples:
    """The gain by the law, ones where no law explains a good part, (n,).

    Heard (n,): the predicted voice as the microphone gets it.
    """
    ones = np.ones(heard.size, np.float32)
    if measurement.noise_psd is None:
        return ones
    fan = float(measurement.noise_psd.sum()) * SAMPLE_RATE / 2 / (measurement.noise_psd.size - 1)
    level = 10.0 * np.log10(block_sums(heard.astype(np.float64) ** 2, STEP) / STEP + fan + 1e-12)
    law = follow(level, voice, recording, measurement.weights)
    if law is None or law.misfit > BENDS * law.plain:
        return ones
    position = (np.arange(heard.size) + 0.5) / STEP - 0.5
    return (10.0 ** (np.interp(position, np.arange(law.curve_db.size), law.curve_db) / 20.0)).astype(np.float32)


def _at_samples(knots: Array, n: int) -> Array:
    """A curve through knots, KNOTS_HZ a second, linear between them, (n,)."""
    return np.interp(np.arange(n) * (KNOTS_HZ / SAMPLE_RATE), np.arange(knots.size), knots)


def _pays(curve: Array, voice: Samples, recording: Samples, measurement: Measurement) -> bool:
    """Whether the curve (n,) explains more than a constant by what Bayes' criterion asks for half as many numbers as a spline has knots."""
    constant, varying = (
        float(np.dot(rest**2, measurement.weights)) for rest in (recording - voice, recording - curve * voice)
    )
    count = max(float(measurement.weights.sum()), 2.0)
    return constant - varying > 0.5 * curve.size * KNOTS_HZ / SAMPLE_RATE * np.log(count) * varying / count


def _from_voice(voice: Samples, recording: Samples, measurement: Measurement) -> tuple[Array, Array]:
    """Normal equations of recording = voice * sum of knot gains times hats: upper and main diagonal (2, k), right side (k,)."""
    position = np.arange(voice.size) * (KNOTS_HZ / SAMPLE_RATE)
    left = position.astype(np.int64)
    count = int(left[-1]) + 2 if left.size else 2
    up = position - left
    power = voice.astype(np.float64) ** 2 * measurement.weights
    cross = voice.astype(np.float64) * recording * measurement.weights

    main = _sums(left, power * (1 - up) ** 2, count) + _sums(left + 1, power * up**2, count)
    upper = np.zeros(count)
    upper[1:] = _sums(left, power * up * (1 - up), count)[:-1]
    return np.stack((upper, main)), _sums(left, cross * (1 - up), count) + _sums(left + 1, cross * up, count)


def _from_fan(
    voice: Samples, recording: Samples, measurement: Measurement, overall: float, law: Samples
) -> tuple[Array, Array]:
    """What the fan's power says: to the main diagonal and the right side (k,), from frames to fit on in which the robot is silent."""
    count = int((voice.size - 1) * KNOTS_HZ / SAMPLE_RATE) + 2
    own, heard, by_law = (block_power(x, FRAME) for x in (voice, recording, law))
    usable = blocks(measurement.weights, FRAME).all(axis=1) & (own < SILENT)
    knot = np.round((np.arange(own.size) + 0.5) * FRAME / SAMPLE_RATE * KNOTS_HZ).astype(int)[usable]
    weight = FAN_TRUST * 2 * FRAME
    wanted = np.sqrt(heard[usable] / by_law[usable]) / overall
    return _sums(knot, np.full(knot.size, weight), count), _sums(knot, weight * wanted, count)


def _sums(at: NDArray[np.integer], weights: Array, count: int) -> Array:
    """The weights (n,) summed by the knot (n,) that they are at, (count,) float64."""
    return np.asarray(np.bincount(at, weights, count), float)  # numpy's stub gives integers, weights or not


def _smooth(matrix: Array, right: Array) -> Array:
    """Solve the normal equations with a penalty on second differences (a pentadiagonal system) for a gain around 1, (k,)."""
    count = right.size
    bands = np.zeros((3, count))
    bands[1], bands[2] = matrix[0], matrix[1] + 1e-6
    stiff = 1.0 / BEND**2
    difference = (1.0, -2.0, 1.0)
    for i in range(3):
        for j in range(i, 3):
            bands[2 - (j - i), j : count - 2 + j] += stiff * difference[i] * difference[j]
    return scipy.linalg.solveh_banded(bands, right + 1e-6)


def _time_constant(curve: Array, knots_hz: float) -> float:
    """Seconds until the autocovariance of curve (k,) has fallen to 1/e of its variance; 0 where it is constant."""
    moved = curve - curve.mean()
    variance = float(np.dot(moved, moved))
    if variance < 1e-12:
        return 0.0
    covariance = np.correlate(moved, moved, "full")[curve.size - 1 :] / variance
    below = np.flatnonzero(covariance < np.exp(-1.0))
    return float(below[0] if below.size else curve.size) / knots_hz
