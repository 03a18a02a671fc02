"""An automatic gain control at the microphone: the gain of voice and fan alike drifts with time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.frames import block_power, block_sums, blocks
from edgefilter.dsp.psd import total_power
from edgefilter.echo.effect import Effect, Parameter, Runner, numbers, within
from edgefilter.echo.evidence import Evidence
from edgefilter.echo.least_squares import absorbed
from edgefilter.echo.measurement import ORDINARY_DB, SILENT, STEADY_DB, Measurement, Values, VoiceModel, level_ratio
from edgefilter.types import SAMPLE_RATE, Array, Samples

KNOTS_HZ = 4.0
"""Knots per second of a gain curve that follows no law."""
BEND = 0.01
"""Standard deviation of the change of slope of the gain from knot to knot that is expected, relative to the gain."""
STEP = SAMPLE_RATE // 40
"""Samples (25 ms) from one value to the next of a gain that follows a law."""
BENDS = 0.5
"""Of the mean square of the gain's movement, a law must leave less than this to be followed."""
ATTACKS_S, RELEASES_S = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6), (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Times that are tried."""
FINER = (0.7, 1.0, 1.4)
"""Times the best of these, which are tried next."""
SURE = 40.0
"""Energy of the voice over the fan's variance from which on a step tells its gain: to within 1.4 dB."""
MODEL_DB = 0.3
"""By how much any such law is off."""
FAN_ALONE = 1.6
"""Times the fan's power up to which a step may show nothing else: 8 standard deviations of the mean of STEP white samples."""
PERCENTILES = 3.29
"""Standard deviations from the 5th to the 95th percentile."""
FASTEST_S = 0.05
"""Least time constant with which the running filter follows, three hops."""
CORRELATED = 16.0
"""By how much more the samples of a voice vary together than those of white noise."""
LEFT_MEMORY = 0.2
"""Share of a hop in the energy that the gain leaves."""
FRAME = SAMPLE_RATE // 8
"""Samples (125 ms) over which the fan's power is measured."""
FAN_TRUST = 0.25
"""Weight of a silent frame relative to what white noise would deserve: the fan is only known to some tenths of a dB."""


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
        if not knots.any():
            return x.copy()
        position = np.arange(x.size) * (float(values["knots_hz"]) / sample_rate)
        return (x * 10.0 ** (np.interp(position, np.arange(knots.size), knots) / 20.0)).astype(np.float32)

    def run(self, values: Values, sample_rate: int) -> Runner | None:
        """A follower of the gain, as far and as fast as it moved in the recording; none where it stood still."""
        spread = float(values["range_db"])
        if spread < ORDINARY_DB:
            return None
        middle = 10.0 ** (float(np.median(numbers(values, "gain_db"))) / 20.0)
        return GainFollower(middle, spread, float(values["time_constant_s"]), sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """A law by which the gain follows the level, where there is one, and what differs from it slowly.

        The latter by penalised least squares of the gain at the knots, from the voice where it sounds, else from the fan's
        power: a smoothing spline of first order (Eilers & Marx 1996, with second differences), which bridges what is not fitted.
        """
        heard, predicted = measurement.predicted(model)
        recording = measurement.white_recording
        voice = absorbed(predicted, recording, measurement.fit)
        overall = level_ratio(voice, predicted)
        overall = overall if overall > 1e-3 else 1.0
        law = _law(heard, voice, recording, measurement)
        matrix, right = _from_voice(voice * law, recording, measurement)
        if measurement.noise_psd is not None:
            for_fan, wanted = _from_fan(voice, recording, measurement, overall, law)
            matrix[1] += for_fan
            right += wanted
        knots = _smooth(matrix, right)
        gain = law * np.interp(np.arange(law.size) * (KNOTS_HZ / SAMPLE_RATE), np.arange(knots.size), knots)
        if not _pays(gain, voice, recording, measurement):
            return within(self, {"gain_db": 20.0 * np.log10(overall), "range_db": 0.0, "time_constant_s": 0.0})
        step = int(SAMPLE_RATE / KNOTS_HZ) if np.all(law == 1.0) else STEP
        curve = 20.0 * np.log10(np.clip(np.append(gain, gain[-1:])[::step] * overall, 1e-3, 1e3))
        low, high = np.percentile(curve, [5, 95])
        knots_hz = SAMPLE_RATE / step
        report = {"range_db": high - low, "time_constant_s": _time_constant(curve, knots_hz)}
        return within(self, {"gain_db": curve, "knots_hz": knots_hz, **report})

    def sentence(self, values: Values) -> str:
        return "voice and fan rise and fall together with a slow gain"

    def plausible(self, evidence: Evidence) -> bool:
        """Whether the fan moves with the gain, as it does behind a microphone's control and does not behind a player's.

        By the likelihood of the residual's power in steps where little but the fan is left, at one level or times the gain's square.
        """
        if float(evidence.values["range_db"]) < ORDINARY_DB or abs(evidence.silent_db) > STEADY_DB:
            return False
        measurement = evidence.grid.measurement
        gain = self.apply(np.ones_like(measurement.recording), evidence.values, SAMPLE_RATE)
        white = measurement.whiten(measurement.recording - evidence.after.prediction).astype(np.float64) ** 2
        square, power = (block_sums(x, STEP) / STEP for x in (gain.astype(np.float64) ** 2, white))
        low = (power < FAN_ALONE * square) & (block_sums(evidence.grid.usable, STEP) == STEP)
        if low.sum() < 20:
            return False
        moving = np.log(np.mean(power[low] / square[low])) + np.mean(np.log(square[low]))
        return bool(moving < np.log(np.mean(power[low])))


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


def _law(heard: Samples, voice: Samples, recording: Samples, measurement: Measurement) -> Samples:
    """The gain by the law, ones where no law explains a good part, (n,); heard (n,): the predicted voice as the microphone gets it."""
    ones = np.ones(heard.size, np.float32)
    if measurement.noise_psd is None:
        return ones
    fan = total_power(measurement.noise_psd)
    level = 10.0 * np.log10(block_sums(heard.astype(np.float64) ** 2, STEP) / STEP + fan + 1e-12)
    law = follow(level, voice, recording, measurement.weights)
    if law is None or law.misfit > BENDS * law.plain:
        return ones
    position = (np.arange(heard.size) + 0.5) / STEP - 0.5
    return (10.0 ** (np.interp(position, np.arange(law.curve_db.size), law.curve_db) / 20.0)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class GainLaw:
    """A gain that follows a level. curve_db: (k,) the gain at the middle of each step, relative to a constant.

    misfit, plain: weighted mean square of what is left of the measured gains, dB^2, with the law and with a constant.
    """

    curve_db: Array
    misfit: float
    plain: float


def follow(level_db: Array, voice: Samples, recording: Samples, weights: Samples) -> GainLaw | None:
    """The law whose gain, driven by the level (k,) in dB of each step, agrees best with that of recording (n,) over voice (n,).

    Both whitened; weights (n,). A feed-forward control in dB with smoothed gain (Giannoulis, Massberg & Reiss 2012, eq.
    7 and 16): it falls with the attack time, rises with the release time, and by slope dB per dB; a feed-back control
    with a linear law is the same with shorter times. None where too little of the voice is heard.
    """
    energy, cross = (block_sums(voice * other * weights, STEP) for other in (voice, recording))
    sure = (energy > SURE) & (cross > 0.05 * energy)
    if sure.sum() < 20:
        return None
    gain_db = 20.0 * np.log10(cross[sure] / energy[sure])
    trust = 1.0 / (75.4 / energy[sure] + MODEL_DB**2)
    trust /= trust.sum()
    middle = float(trust @ gain_db)
    loud = np.quantile(level_db[sure], (0.1, 0.3, 0.6, 0.9))

    def best(*choices: Array) -> tuple[float, Array, tuple[float, ...]]:
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*choices)])
        moved = _driven(level_db, *grid)
        seen = moved[sure] - trust @ moved[sure]
        power = np.einsum("k,km,km->m", trust, seen, seen)
        slope = np.clip(((trust * (gain_db - middle)) @ seen) / (power + 1e-9), 0.0, 1.0)
        left = np.einsum("k,km->m", trust, (gain_db[:, None] - middle - slope * seen) ** 2)
        i = int(np.argmin(left))
        return float(left[i]), slope[i] * (moved[:, i] - trust @ moved[sure, i]) + middle, tuple(grid[:, i])

    holds = np.array([-np.inf, loud[0] - 10.0, loud[0], loud[1]])
    found = best(np.array(ATTACKS_S), np.array(RELEASES_S), holds, -loud[1:])
    attack, release, hold, start = found[2]
    around, starts = np.array(FINER), start + np.arange(-6.0, 6.1, 3.0)
    finer = best(attack * around, release * around, hold + np.array([-5.0, 0.0, 5.0]), starts)
    misfit, curve, _ = min(found, finer, key=lambda law: law[0])
    return GainLaw(curve, misfit, float(trust @ (gain_db - middle) ** 2))


def _driven(level_db: Array, attack_s: Array, release_s: Array, hold_db: Array, start_db: Array) -> Array:
    """Gain in dB, for a slope of 1, of m controls that follow level (k,), (k, m)."""
    fall, rise = (1.0 - np.exp(-STEP / SAMPLE_RATE / seconds) for seconds in (attack_s, release_s))
    gain, curve = start_db.astype(float), np.empty((level_db.size, start_db.size))
    for i, level in enumerate(level_db.tolist()):
        missing = -level - gain
        gain = gain + np.where(missing < 0.0, fall, rise) * missing * (level > hold_db)
        curve[i] = gain
    return curve


def _pays(curve: Array, voice: Samples, recording: Samples, measurement: Measurement) -> bool:
    """Whether the curve (n,) explains more than a constant by Bayes' criterion for half as many numbers as a spline has knots."""
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
    """What the fan's power adds to main diagonal and right side (k,), from frames to fit on in which the robot is silent."""
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
