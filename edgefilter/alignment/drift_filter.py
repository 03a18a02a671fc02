"""A delay that clocks let drift: a Kalman filter over delay and drift that doubts itself where its surprises agree."""

from __future__ import annotations

import math

from edgefilter.alignment.delay_tracker import FRAME, STRIDE, DelayMeasurement

SLOPE_DEVIATION = 150e-6
"""Standard deviation of two clocks' difference before anything is known, samples per sample."""
STEEPEST = 600e-6
"""Slope that is never exceeded; clocks differ by half of it."""
UNEXPECTED = 5.0
"""Standard deviations from which on a look contradicts what is believed."""
BIAS = 0.1
"""Samples by which looks err alike where the response that is supposed explains nothing of the microphone."""
DECIDED = 30.0
"""Evidence of a look from which on its peak is the direct sound's."""


class DriftFilter:
    """Kalman filter over the delay (samples) and its slope (samples per sample), constant-slope model.

    What a look claims of its own accuracy does not hold while a human talks as well or the response is still being
    learnt: looks close to one another then err alike. So they weigh less the less they explain, and where looks that
    agree contradict what is believed, belief is widened until it can follow them (fading memory, Sorenson & Sacks
    1971).
    """

    def __init__(self) -> None:
        self.delay, self.slope = float("nan"), 0.0
        self._variance, self._covariance, self._slope_variance = 4.0, 0.0, SLOPE_DEVIATION**2
        self._since = 0

    @property
    def deviation(self) -> float:
        """Standard deviation of the delay, samples."""
        return math.sqrt(self._variance)

    def restart(self, delay: float, deviation: float) -> None:
        """Another delay, known to +-deviation samples; the slope stays, the clocks are the same."""
        self.delay = delay
        self._variance, self._covariance = deviation**2, 0.0
        self._since = 0

    def step(self, offset: float, deviation: float) -> None:
        """The delay is another one by a small offset, which a wrong slope may have brought about since the last look, or a jump."""
        wrong = offset / max(self._since, STRIDE)
        if abs(self.slope + wrong) < STEEPEST:
            self._slope_variance = min(self._slope_variance + wrong**2, SLOPE_DEVIATION**2)
        self.restart(self.delay + offset, deviation)

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

    def correct(self, measurement: DelayMeasurement) -> None:
        """Take in a measured offset, which holds for the middle of its frame."""
        noise, spread = self._noise(measurement), self._expected()[2]
        surprise = measurement.offset / math.sqrt(spread + noise)
        if abs(surprise) > UNEXPECTED:
            self._widen((measurement.offset**2 - noise) / spread)
        delay, slope, spread = self._expected()
        spread += noise
        gain = measurement.offset / spread
        self.delay += delay * gain
        self.slope = min(max(self.slope + slope * gain, -STEEPEST), STEEPEST)
        self._variance -= delay * delay / spread
        self._covariance -= delay * slope / spread
        self._since = 0
        self._slope_variance -= slope * slope / spread

    def _noise(self, measurement: DelayMeasurement) -> float:
        """Variance of a look, with what its error has in common with its neighbours', which their number does not average out.

        While the delay is hardly known, a weak look may also have seen another peak than the direct sound's.
        """
        common = BIAS**2 * (1.0 - measurement.explained)
        return (
            measurement.variance + common + (1.0 if self._variance > 0.25 and measurement.evidence < DECIDED else 0.0)
        )

    def _widen(self, factor: float) -> None:
        """Believe less of delay and slope, by this factor of their covariance, but never less than at the start."""
        factor = min(factor, 4.0 / self._variance, SLOPE_DEVIATION**2 / self._slope_variance)
        if factor > 1.0:
            self._variance *= factor
            self._covariance *= factor
            self._slope_variance *= factor

    def _expected(self) -> tuple[float, float, float]:
        """Covariance of the offset in the middle of the frame with the delay, with the slope, and its variance."""
        half = FRAME / 2.0
        delay = self._variance - half * self._covariance
        slope = self._covariance - half * self._slope_variance
        return delay, slope, delay - half * slope
