"""Looks at one delay, from the cross-spectrum, and what is believed after them: a delay that drifts or jumps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from edgefilter.alignment.delay_line import DelayBuffer
from edgefilter.alignment.lag_search import CERTAIN, NEAR
from edgefilter.alignment.utterances import LAST_BIT
from edgefilter.dsp import fourier
from edgefilter.dsp.fourier import power
from edgefilter.dsp.lag import climb, turn
from edgefilter.dsp.psd import hann
from edgefilter.types import PRE_ROLL, Array, Samples

FRAME = 2048
"""Samples of microphone in one measurement, Hann-weighted."""
STRIDE = 1024
"""Samples between two measurements."""
REACH = 1024
"""Largest jump that the tracker sees, samples; beyond it the whole range is searched."""
SIZE = REACH + FRAME + REACH
EARLY = (48, 400)
"""Samples before and after the direct sound that the learnt response keeps."""
SMALL = 8.0
"""Samples of a jump up to which it may also be a wrong slope, and is half as likely as to any other lag within REACH."""
E_FOLD = 2.47
"""Evidence that makes a jump e times as likely; one beyond REACH is less likely than one within by CERTAIN twice. In 7 minutes of human
speech, while the reference was played but not heard, looks that agreed had an evidence of up to 19 within REACH and 29 beyond, with
exponential tails. So that of a certain jump, 30 or 56, comes about once in 100 hours of such speech, beyond REACH once in 50."""
ONE_LOOK = math.log(CERTAIN * 2 * REACH)
"""Logarithm of the likelihood ratio that one look shows at most, with which a jump within REACH is as good as certain: what is heard in an
eighth of a second through a microphone that is processed may agree with the reference at any delay."""
COUNTS = 6.0
"""Strength of a look's peak over the rms of +-REACH lags from which it counts."""
FAINT, STRANGE, EDGE = 0.25, 10.0, 64
"""Lower and upper limit of the microphone's power over the expected echo's, outside of which no jump can be measured, and samples
at each end of the range in which none is believed."""
DRIFTED = 1.5
"""Samples. Two measured delays that differ by less show the same jump; a smaller change is the clocks' drift, since a lost or repeated
buffer makes a larger one."""
EXPECTED, UNEXPECTED = 3.0, 5.0
"""Gates, in standard deviations, for the measured delay less the predicted one. A difference of less than SMALL samples counts as drift up
to EXPECTED, one of less than DRIFTED samples up to UNEXPECTED; any other contradicts the estimate. With 3 for both gates 2 of 16
simulated conversations had 1.1 and 0.5 dB less SI-SDR."""
SLOPE_DEVIATION = 150e-6
"""Standard deviation of the difference of the clocks of playback and capture before anything is heard, samples per sample. A difference of more
than UNEXPECTED times this is not accepted."""
BIAS = 0.1
"""Samples by which looks err alike where the response that is supposed explains nothing of the microphone."""


@dataclass(frozen=True, slots=True)
class DelayMeasurement:
    """What one look at a delay found.

    offset: delay error, samples (positive: the microphone is later). variance: of the offset, samples^2. strength: height
    of the peak over the rms of all lags. ratio: height over the highest peak elsewhere. explained: share of the microphone's
    whitened power that the early response explains, 0 to 1. gain: power ratio of microphone to reference; gain_there: the
    same if the offset is true.
    """

    offset: float
    variance: float
    strength: float
    ratio: float
    explained: float
    gain: float
    gain_there: float

    @property
    def evidence(self) -> float:
        """Strength times ratio: how far the peak stands out of chance."""
        return self.strength * self.ratio


class DelayMeter:
    """Measures the delay of the microphone against the reference read at an expected delay: its error, and other places in reach.

    The likelihood of an offset tau under M = H A exp(-j omega tau) + V is Re sum conj(H) G exp(j omega tau) / S_V with
    G = M conj(A) and S_V the smoothed power of what H A leaves unexplained (Hannan & Thomson 1973 weights). H, the
    early response relative to the direct sound, starts from the profile's (taps,) or a pure delay and is learnt; each
    cross-spectrum is shifted by its own offset first, so that learning does not move the delay. Peaks are compared
    after division by the root of the energy that a lag lets overlap, with which chance peaks grow.
    """

    def __init__(self, response: Samples | None = None) -> None:
        self._window = hann(FRAME).astype(np.float32)
        self._omega = (2 * np.pi * np.arange(SIZE // 2 + 1) / SIZE).astype(np.float32)
        self._omega_squared = np.square(self._omega)
        band = (self._omega > 2 * np.pi * 120 / 16000) & (self._omega < 2 * np.pi * 7000 / 16000)
        self._band, self._band_size = band.astype(np.float32), float(np.count_nonzero(band))
        self._framed = np.zeros((3, SIZE), np.float32)
        self._prior = np.ones(self._omega.size, np.complex64)
        self._prior_blocks = 4.0
        if response is not None:
            early = np.zeros(SIZE, np.float32)
            count = min(PRE_ROLL + EARLY[1], response.size)
            early[:count] = response[:count]
            self._prior = fourier.rfft(np.roll(early, -PRE_ROLL)).astype(np.complex64)
            self._prior_blocks = 16.0
        self._blocks = 0.0  # 0 until the first measurement
        self._cross = np.zeros_like(self._prior)
        self._power: Array = np.zeros_like(self._omega)
        self._total = 0.0
        self._confirmed: float | None = None
        self.response = self._prior

    def measure(
        self, mic: DelayBuffer, ref: DelayBuffer, now: int, delay: float, slope: float, far: bool
    ) -> DelayMeasurement | None:
        """Measure the delay of the last FRAME samples of mic, near the expected one; None where microphone or reference is silent.

        far: also up to 2 REACH lags further away, earlier and later.
        """
        centre = delay - slope * (FRAME / 2)
        whole = round(centre)
        start = now - FRAME - REACH - whole
        x, inner, wide = self._framed
        np.multiply(mic.read(now - FRAME, now), self._window, out=x[REACH:-REACH])
        wide[:] = ref.read(start, start + SIZE)
        np.multiply(wide[REACH:-REACH], self._window, out=inner[REACH:-REACH])
        energy, drive = float(x.dot(x)), float(inner.dot(inner))
        if not (drive > LAST_BIT and energy > 0.0):
            return None
        m, a, w = fourier.rfft(self._framed)
        m *= turn(self._omega, centre - whole)
        power_a = power(a)
        if not self._blocks:
            self._start(power(m), power_a)
        self._last = (m * np.conj(a), power_a)
        powers = power(np.array((m - self.response * a, m)))
        # into an array of ours: to make its own takes scipy as long again
        left, power_m = uniform_filter1d(powers, 31, output=np.empty_like(powers), mode="nearest")
        weight = self._band / (left + 0.05 * power_m + (1e-6 * power_m.max() + 1e-20))
        m *= np.conj(self.response)
        m *= weight
        products, references = [m * np.conj(w)], [wide]
        if far:
            sides = [ref.read(start + x, start + x + SIZE) for x in (2 * REACH, -2 * REACH)]
            before, after = (m * np.conj(fourier.rfft(side)) for side in sides)
            products, references = [before, *products, after], [sides[0], wide, sides[1]]
        correlation = fourier.irfft(np.array(products), SIZE)
        likelihood = np.concatenate((correlation[:, -REACH:], correlation[:, :REACH]), axis=1).ravel()
        overlap = np.concatenate([_overlap(reference) for reference in references])
        # by the energy of the first difference: a constant offset of the reference has none
        likelihood /= np.sqrt(overlap + 0.1 * overlap.max() + 1e-30)
        expected = likelihood.size // 2
        at, strength, ratio = max(
            (_highest(likelihood, reach) for reach in {REACH, expected}), key=lambda found: found[1] * found[2]
        )
        part, inside = divmod(at, 2 * REACH)
        offset = at - inside + REACH - expected + climb(products[part], self._omega, inside - REACH, steps=3)
        there = references[part][SIZE - FRAME - inside : SIZE - inside] * self._window
        information = 2.0 * float(self._omega_squared.dot(power(self.response) * power_a * weight)) * FRAME / SIZE
        explained = 1.0 - float(self._band.dot(left / (power_m + 1e-20))) / self._band_size
        return DelayMeasurement(
            offset=offset,
            variance=4.0 / (information + 1e-30) + 1e-4,
            strength=strength,
            ratio=ratio,
            explained=min(max(explained, 0.0), 1.0),
            gain=energy / drive,
            gain_there=energy / (float(there.dot(there)) + 1e-30),
        )

    def confirm(self, offset: float) -> None:
        """The last measurement was believed, with this offset: `learn`, when there is time, takes it into the response."""
        self._confirmed = offset

    def study(self, mic: DelayBuffer, ref: DelayBuffer, start: int, now: int, delay: float, slope: float) -> None:
        """Learn the response from samples start to now, in which a search found this delay. Later measurements of other samples can refute it."""
        for end in range(start + FRAME, now - FRAME + 1, STRIDE):
            if self.measure(mic, ref, end, delay, slope, far=False):
                self.confirm(0.0)
                self.learn()

    def learn(self) -> None:
        """Take what was confirmed last, if it has not been taken yet, into the response: its cross-spectrum, shifted by its offset."""
        if self._confirmed is None:
            return
        offset, self._confirmed = self._confirmed, None
        cross, power = self._last
        level = float(self._total / (np.add.reduce(power) + 1e-20)) / self._blocks
        rate = min(max(level, 0.03), 3.0)
        self._cross = 0.98 * self._cross + rate * cross * turn(self._omega, offset)
        self._power = 0.98 * self._power + rate * power
        self._total = np.add.reduce(self._power)
        self._blocks = 0.98 * self._blocks + 1.0
        impulse = fourier.irfft(self._cross / (self._power + 1e-3 * (self._total / self._power.size)), SIZE)
        impulse[EARLY[1] : SIZE - EARLY[0]] = 0.0
        self.response = fourier.rfft(impulse)

    def _start(self, power_m: Samples, power_a: Samples) -> None:
        smooth = uniform_filter1d(power_a, 65, mode="nearest")
        scale = 0.7 * float(np.sqrt(power_m.sum() / (power(self._prior).dot(power_a) + 1e-20)))
        self._blocks = self._prior_blocks
        self._power = self._blocks * smooth
        self._total = np.add.reduce(self._power)
        self._cross = self._blocks * smooth * self._prior * np.float32(scale)
        self.response = self._prior * np.float32(scale)


def _highest(likelihood: Samples, reach: int) -> tuple[int, float, float]:
    """Index of the highest peak at most `reach` lags from the middle, and its strength and ratio (see DelayMeasurement) among these lags."""
    first = likelihood.size // 2 - reach
    inner = likelihood[first : first + 2 * reach]
    at = int(inner.argmax())
    peak = float(inner[at])
    elsewhere = max(inner[: max(at - NEAR, 0)].max(initial=0.0), inner[at + NEAR :].max(initial=0.0))
    rms = math.sqrt(float(inner.dot(inner)) / inner.size)
    return first + at, peak / (rms + 1e-20), peak / max(float(elsewhere), 1e-20)


def _overlap(reference: Samples) -> Samples:
    """Energy of the reference's first difference under the middle half of the frame, at offsets -REACH to REACH - 1, (2 REACH,)."""
    earliest, half = FRAME // 4, FRAME // 2
    latest = earliest + half + 2 * REACH
    change = reference[earliest + 2 : latest + 2] - reference[earliest + 1 : latest + 1]
    total = np.add.accumulate(np.square(change, out=change).astype(np.float64))
    return (total[half:] - total[:-half])[::-1].astype(np.float32)


class DriftFilter:
    """Kalman filter that tracks the delay (samples) and its slope (samples per sample), constant but for jumps of the delay.

    The accuracy that a measurement reports is too optimistic while a human talks as well or the response is still being learnt:
    the errors of measurements close to one another are then alike. So a measurement weighs less the less of the microphone it
    explains, and where measurements agree with one another but contradict the estimate, its covariance grows until it can
    follow them (fading memory, Sorenson & Sacks 1971). What the latest looks that agree on a jump have seen is remembered.

    >>> look = DelayMeasurement(100.0, 0.01, strength=10.0, ratio=1.6, explained=0.5, gain=1.0, gain_there=1.0)
    >>> drift = DriftFilter()
    >>> drift.convinced(look), drift.convinced(look)
    (False, True)
    """

    def __init__(self) -> None:
        self.slope, self._slope_variance = 0.0, SLOPE_DEVIATION**2
        self.restart(float("nan"))
        self.shared = float("inf")  # no delay is known

    @property
    def deviation(self) -> float:
        """Standard deviation of the delay, samples, with the error that all measurements share, which no further one reduces."""
        return math.hypot(math.sqrt(self._variance), self.shared)

    def restart(self, delay: float, deviation: float = SMALL / EXPECTED) -> None:
        """Another delay, known to +-deviation samples; the slope stays, the clocks are the same. A search finds it to within SMALL."""
        self.delay, self.shared = delay, 0.0
        self._variance, self._covariance = deviation**2, 0.0
        self._since = 0
        self._jump, self._shown = float("nan"), 0.0

    def step(self, found: DelayMeasurement) -> None:
        """Move the delay by the measured offset: it has jumped. A small offset may as well come from a wrong slope since the last measurement."""
        wrong = found.offset / max(self._since, STRIDE)
        if abs(found.offset) <= SMALL and abs(self.slope + wrong) < UNEXPECTED * SLOPE_DEVIATION:
            self._slope_variance = min(self._slope_variance + wrong**2, SLOPE_DEVIATION**2)
        self.restart(self.delay + found.offset, math.sqrt(self._noise(found)))

    def advance(self, samples: int) -> None:
        """Let `samples` samples pass."""
        self._since += samples
        self.delay += self.slope * samples
        self._variance += samples * (2.0 * self._covariance + samples * self._slope_variance) + 1e-6 * samples / STRIDE
        self._covariance += samples * self._slope_variance
        self._slope_variance += (0.15e-6) ** 2 * samples / STRIDE

    def surprise(self, measurement: DelayMeasurement) -> float:
        """The measured offset in standard deviations of what was to be expected."""
        return abs(measurement.offset) / math.sqrt(self._expected()[2] + self._noise(measurement))

    def where_seen(self, found: DelayMeasurement, gain: float, far: bool) -> str:
        """Whether a look, far or not, saw the robot where it was expected.

        "there": it did. "elsewhere": it saw it at another delay, which is remembered; "jumped": other looks agree.
        "unseen": not at all. "drowned": somebody louder hid it. gain: power that the robot has brought so far.
        """
        size, surprise = abs(found.offset), self.surprise(found)
        if found.strength < COUNTS:
            return "unseen"
        if (size < DRIFTED and surprise < UNEXPECTED) or (size < SMALL and surprise < EXPECTED):
            return "there"
        if found.gain > STRANGE * gain:
            return "drowned"
        if not FAINT < found.gain_there / gain < STRANGE or size > (3 if far else 1) * REACH - EDGE:
            return "unseen"
        return "jumped" if self.convinced(found) else "elsewhere"

    def convinced(self, found: DelayMeasurement) -> bool:
        """Take in a look at which the delay seems to have jumped by its offset; True if that is certain now, by the looks that agree on it."""
        shown, size = min(found.evidence / E_FOLD, ONE_LOOK), abs(found.offset)
        if abs(found.offset - self._jump) < DRIFTED:
            shown += self._shown
        self._jump, self._shown = found.offset, shown
        lags = 4 * SMALL + 1 if size <= SMALL else 2 * REACH if size <= REACH else CERTAIN**2 * 6 * REACH
        return self._shown > math.log(CERTAIN * lags)

    def correct(self, measurement: DelayMeasurement) -> None:
        """Take in a measured offset, which holds for the middle of its frame."""
        noise = self._noise(measurement)
        if self.surprise(measurement) > UNEXPECTED:  # believe less, but never less than at the start
            factor = (measurement.offset**2 - noise) / self._expected()[2]
            factor = max(min(factor, 4.0 / self._variance, SLOPE_DEVIATION**2 / self._slope_variance), 1.0)
            self._variance *= factor
            self._covariance *= factor
            self._slope_variance *= factor
        delay, slope, spread = self._expected()
        spread += noise
        gain = measurement.offset / spread
        self.delay += delay * gain
        steepest = UNEXPECTED * SLOPE_DEVIATION
        self.slope = min(max(self.slope + slope * gain, -steepest), steepest)
        self._variance -= delay * delay / spread
        self._covariance -= delay * slope / spread
        self._since = 0
        self._slope_variance -= slope * slope / spread
        self._jump, self._shown = float("nan"), 0.0

    def _noise(self, measurement: DelayMeasurement) -> float:
        """Variance of a look, with what its error has in common with its neighbours', which their number does not average out.

        While the delay is hardly known, a weak look may also have seen another peak than the direct sound's.
        """
        common = BIAS**2 * (1.0 - measurement.explained)
        doubtful = self._variance > 0.25 and measurement.evidence / E_FOLD < ONE_LOOK
        return measurement.variance + common + (1.0 if doubtful else 0.0)

    def _expected(self) -> tuple[float, float, float]:
        """Covariances of the delay error at the middle of the frame with the delay and with the slope, and its own variance."""
        half = FRAME / 2.0
        delay = self._variance - half * self._covariance
        slope = self._covariance - half * self._slope_variance
        return delay, slope, delay - half * slope
