"""An automatic gain control at the microphone: the gain of voice and fan alike drifts with time."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.frames import amplitude, block_sums
from edgefilter.echo.effect import Effect, Parameter, Runner, neutral, numbers, within
from edgefilter.echo.least_squares import absorbed, hats
from edgefilter.echo.measurement import ORDINARY_DB, Measurement, Values, VoiceModel, level_ratio
from edgefilter.types import SAMPLE_RATE, Array, Samples

KNOTS_HZ = 4.0
"""Knots per second of the gain's curve."""
STEP = int(SAMPLE_RATE / KNOTS_HZ) // 8
"""Samples (31 ms) over which energies are summed, an eighth from knot to knot."""
FAN_ALONE = 1.6
"""Times the fan's power up to which a step may show nothing else: 9 standard deviations of the mean of STEP white samples."""
BEND = 0.01
"""Standard deviation of the change of slope of the gain from knot to knot that is expected, relative to the gain."""
PERCENTILES = 3.29
"""Standard deviations from the 5th to the 95th percentile."""
FASTEST_S = 0.05
"""Least time constant with which the running filter follows, three hops."""
CORRELATED = 16.0
"""By how much more the samples of a voice vary together than those of white noise."""
LEFT_MEMORY = 0.2
"""Share of a hop in the energy that the gain leaves."""


class MicAgc(Effect):
    """y(t) = g(t) x(t), g in dB piecewise linear between its knots; what the microphone hears of the fan gets the same gain.

    gain_db: (k,) at 0, 1 / knots_hz, 2 / knots_hz ..., the last one held, or one number. range_db and time_constant_s
    only report: the spread of the gain between its 5th and 95th percentile, and the lag at which the gain's
    autocovariance has fallen to 1/e.
    """

    name = "mic_agc"
    stage = "microphone"
    family = "dynamics"
    title = "a microphone gain control"
    run_note = (
        "its curve is of this recording; the running filter follows the gain by itself, as far and as fast as here"
    )
    event = True
    complexity = 1
    flexible = True
    parameters = (
        Parameter("gain_db", "dB", 0.0, -60.0, 60.0),
        Parameter("knots_hz", "1/s", KNOTS_HZ, 0.01, 1000.0),
        Parameter("range_db", "dB", 0.0, 0.0, 120.0),
        Parameter("time_constant_s", "s", 0.0, 0.0, 1e4),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        knots = numbers(values, "gain_db")
        position = np.arange(x.size) * (float(values["knots_hz"]) / sample_rate)
        return (x * amplitude(np.interp(position, np.arange(knots.size), knots))).astype(np.float32)

    def run(self, values: Values, sample_rate: int) -> Runner | None:
        """A follower of the gain, as far and as fast as it moved in the recording; none where it stood still."""
        spread = float(values["range_db"])
        if spread < ORDINARY_DB:
            return None
        middle = 10.0 ** (float(np.median(numbers(values, "gain_db"))) / 20.0)
        return GainFollower(middle, spread, float(values["time_constant_s"]), sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Penalised least squares of the gain at the knots, from the voice where it sounds.

        A smoothing spline of first order (Eilers & Marx 1996, with second differences), which bridges what is not fitted.
        Neutral where it does not move, or the fan does not move with it.
        """
        predicted = measurement.predicted(model)[1]
        recording = measurement.white_recording
        voice = absorbed(predicted, recording, measurement.fit)
        overall = level_ratio(voice, predicted)
        overall = overall if overall > 1e-3 else 1.0
        energy, cross = (block_sums(voice * other * measurement.weights, STEP) for other in (voice, recording))
        count = energy.size // 8 + 2
        parts = hats((np.arange(energy.size) + 0.5) / 8.0, np.arange(float(count)))
        bends = np.diff(np.eye(count), 2, axis=0) / BEND
        matrix = (parts * energy) @ parts.T + bends.T @ bends + 1e-6 * np.eye(count)
        knots = np.linalg.solve(matrix, parts @ cross + 1e-6)
        gain = np.interp(np.arange(voice.size) * (KNOTS_HZ / SAMPLE_RATE), np.arange(knots.size), knots)
        pays = _pays(gain, voice, recording, measurement)
        if not pays or not _fan_moves(gain * overall, recording - gain * voice, measurement):
            return neutral(self)
        curve = 20.0 * np.log10(np.clip(knots * overall, 1e-3, 1e3))
        low, high = np.percentile(curve, [5, 95])
        return within(self, {"gain_db": curve, "range_db": high - low, "time_constant_s": _time_constant(curve)})

    def sentence(self, values: Values) -> str:
        return "voice and fan rise and fall together with a slow gain"


class GainFollower:
    """Puts the gain of the moment on the predicted voice: a scalar Kalman filter on what the microphone heard of it.

    The gain is taken to move around its middle as a first-order Markov process whose 5th and 95th percentile are range_db
    apart and whose autocovariance falls to 1/e in time_constant_s. A hop tells it with the variance of what the gain
    leaves over the voice's energy, times CORRELATED: a voice's samples are not independent.
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


def _pays(curve: Array, voice: Samples, recording: Samples, measurement: Measurement) -> bool:
    """Whether the curve (n,) explains more than a constant by Bayes' criterion for half as many numbers as a spline has knots."""
    constant, varying = (
        float(np.dot(rest**2, measurement.weights)) for rest in (recording - voice, recording - curve * voice)
    )
    count = max(float(measurement.weights.sum()), 2.0)
    return constant - varying > 0.5 * curve.size * KNOTS_HZ / SAMPLE_RATE * np.log(count) * varying / count


def _fan_moves(gain: Array, rest: Samples, measurement: Measurement) -> bool:
    """Whether the fan has the gain (n,) as well, as it does behind a microphone's control and does not behind a player's.

    By the likelihood of the rest's (n,) power in steps where little but the fan is left, at one level or times the gain's square.
    """
    square, power, fitted = (block_sums(x, STEP) / STEP for x in (gain**2, rest * rest, measurement.weights))
    low = (power < FAN_ALONE * square) & (fitted == 1.0)
    if not low.any():
        return False
    moving = np.log(np.mean(power[low] / square[low])) + np.mean(np.log(square[low]))
    return bool(moving < np.log(np.mean(power[low])))


def _time_constant(curve: Array) -> float:
    """Seconds until the autocovariance of curve (k,) has fallen to 1/e of its variance; 0 where it is constant."""
    moved = curve - curve.mean()
    variance = float(np.dot(moved, moved))
    if variance < 1e-12:
        return 0.0
    covariance = np.correlate(moved, moved, "full")[curve.size - 1 :] / variance
    below = np.flatnonzero(covariance < np.exp(-1.0))
    return float(below[0] if below.size else curve.size) / KNOTS_HZ
