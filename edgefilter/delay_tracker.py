"""Fine tracking of one delay: sub-sample error from the cross-spectrum, a Kalman filter over (delay, drift), jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d

from edgefilter.delay_line import Tape, read_line
from edgefilter.types import Samples

FRAME = 2048
"""Samples of microphone in one measurement, Hann-weighted."""
STRIDE = 1024
"""Samples between two measurements."""
REACH = 1024
"""Largest jump that the tracker sees, samples; beyond it the whole range is searched."""
SIZE = FRAME + 2 * REACH
EARLY = (48, 400)
"""Samples before and after the direct sound that the learnt response keeps."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """offset: delay error, samples (positive: the microphone is later). variance: samples^2. strength: height of the peak over
    the rms of all lags. dominance: height over the best within 2 samples of the expected delay. explained: share of the
    microphone's whitened power that the early response explains, 0 to 1. gain: power ratio of microphone to reference."""

    offset: float
    variance: float
    strength: float
    dominance: float
    explained: float
    gain: float


class DelayMeter:
    """Measures the delay of the microphone against the reference read at an expected delay.

    The likelihood of an offset tau under M = H A exp(-j omega tau) + V is Re sum conj(H) G exp(j omega tau) / S_V with G = M conj(A)
    and S_V the smoothed power of what H A leaves unexplained (Hannan & Thomson 1973 weights). H, the early response relative to
    the direct sound, starts from the profile (or from a pure delay) and is learnt; each cross-spectrum is shifted by its own
    offset first, so that learning does not move the delay.
    """

    def __init__(self, response: Samples | None, pre_roll: int) -> None:
        self._window = np.hanning(FRAME + 1)[:FRAME].astype(np.float32)
        self._omega = (2 * np.pi * np.arange(SIZE // 2 + 1) / SIZE).astype(np.float32)
        self._omega_squared = np.square(self._omega)
        band = (self._omega > 2 * np.pi * 120 / 16000) & (self._omega < 2 * np.pi * 7000 / 16000)
        self._band = band.astype(np.float32)
        self._prior = np.ones(self._omega.size, np.complex64)
        self._prior_blocks = 4.0
        if response is not None:
            early = np.zeros(SIZE, np.float32)
            count = min(pre_roll + EARLY[1], response.size)
            early[:count] = response[:count]
            self._prior = fft.rfft(np.roll(early, -pre_roll)).astype(np.complex64)
            self._prior_blocks = 16.0
        self._known_scale = response is not None
        self._cross: np.ndarray | None = None
        self._power: Samples | None = None
        self.response = self._prior

    def measure(self, mic: Tape, ref: Tape, now: int, delay: float, slope: float) -> Measurement | None:
        """Compare the last FRAME samples of mic with the reference at the expected delay; None where either is silent."""
        x = mic.read(now - FRAME, now) * self._window
        wide = read_line(ref, now + REACH, SIZE, delay + slope * REACH, slope, chunk=2048)
        inner = wide[REACH:-REACH] * self._window
        if not (np.dot(inner, inner) > 1e-9 and np.dot(x, x) > 1e-12):
            return None
        framed = np.zeros((2, SIZE), np.float32)
        framed[:, REACH:-REACH] = x, inner
        m, a = fft.rfft(framed, axis=1)
        power_a = _power(a)
        if self._cross is None:
            self._start(_power(m), power_a)
        left = uniform_filter1d(_power(m - self.response * a), 31, mode="nearest")
        power_m = uniform_filter1d(_power(m), 31, mode="nearest")
        spread = left + 0.05 * power_m + 1e-6 * power_m.max() + 1e-20
        weight = np.conj(self.response) * self._band / spread
        product = m * np.conj(fft.rfft(wide)) * weight
        likelihood = fft.irfft(product, SIZE)
        likelihood = np.concatenate((likelihood[-REACH:], likelihood[: REACH + 1]))
        at = int(np.argmax(likelihood))
        near = float(np.max(likelihood[REACH - 2 : REACH + 3]))
        strength = float(likelihood[at]) / (float(np.sqrt(np.mean(np.square(likelihood)))) + 1e-20)
        offset = self._refine(product, at - REACH)
        information = 2.0 * float(np.dot(self._omega_squared, _power(self.response) * power_a * self._band / spread)) * FRAME / SIZE
        explained = 1.0 - float(np.sum(self._band * left / (power_m + 1e-20))) / float(np.sum(self._band))
        self._last = (m * np.conj(a), power_a)
        gain = float(np.dot(x, x) / np.dot(inner, inner))
        dominance = float(likelihood[at]) / max(near, 1e-20)
        return Measurement(offset, 4.0 / (information + 1e-9) + 1e-4, strength, dominance, float(np.clip(explained, 0.0, 1.0)), gain)

    def learn(self, offset: float) -> None:
        """Take the last measured cross-spectrum, shifted by its offset, into the response."""
        cross, power = self._last
        level = float(np.sum(self._power) / (np.sum(power) + 1e-20)) / self._blocks
        rate = float(np.clip(level, 0.03, 3.0))
        self._cross = 0.98 * self._cross + rate * cross * _turn(self._omega, offset)
        self._power = 0.98 * self._power + rate * power
        self._blocks = 0.98 * self._blocks + 1.0
        impulse = fft.irfft(self._cross / (self._power + 1e-3 * self._power.mean()), SIZE)
        impulse[EARLY[1] : SIZE - EARLY[0]] = 0.0
        self.response = fft.rfft(impulse).astype(np.complex64)

    def _start(self, power_m: Samples, power_a: Samples) -> None:
        smooth = uniform_filter1d(power_a, 65, mode="nearest")
        scale = 1.0 if self._known_scale else 0.7 * float(np.sqrt(power_m.sum() / power_a.sum()))
        self._blocks = self._prior_blocks
        self._power = self._blocks * smooth
        self._cross = self._blocks * smooth * self._prior * np.float32(scale)
        self.response = self._prior * np.float32(scale)

    def _refine(self, product: np.ndarray, whole: int) -> float:
        """Newton steps on the likelihood from its highest whole sample, at most one sample away."""
        turned, offset = product * _turn(self._omega, whole), 0.0
        for _ in range(3):
            z = turned * _turn(self._omega, offset)
            slope = -float(np.dot(self._omega, z.imag))
            curvature = -float(np.dot(self._omega_squared, z.real))
            if curvature >= 0.0:
                break
            offset = float(np.clip(offset - slope / curvature, -1.0, 1.0))
        return whole + offset


class DriftFilter:
    """Kalman filter over the delay (samples) and its slope (samples per sample), constant-slope model."""

    def __init__(self) -> None:
        self.delay, self.slope = float("nan"), 0.0
        self.covariance = np.diag([4.0, (150e-6) ** 2])

    def restart(self, delay: float, deviation: float) -> None:
        """Another delay, known to +-deviation samples; the slope stays, the clocks are the same."""
        self.delay = delay
        slope_variance = self.covariance[1, 1]
        self.covariance = np.diag([deviation**2, slope_variance])

    def advance(self, samples: int) -> None:
        """Let `samples` samples pass."""
        self.delay += self.slope * samples
        f = np.array([[1.0, float(samples)], [0.0, 1.0]])
        noise = np.diag([1e-6, (0.15e-6) ** 2]) * (samples / STRIDE)
        self.covariance = f @ self.covariance @ f.T + noise

    def surprise(self, measurement: Measurement) -> float:
        """The measured offset in standard deviations of what was to be expected."""
        return abs(measurement.offset) / float(np.sqrt(self._expected()[1] + measurement.variance))

    def correct(self, measurement: Measurement) -> None:
        """Take in a measured offset, which holds for the middle of its frame."""
        h, spread = self._expected()
        gain = self.covariance @ h / (spread + measurement.variance)
        self.delay += gain[0] * measurement.offset
        self.slope = float(np.clip(self.slope + gain[1] * measurement.offset, -600e-6, 600e-6))
        self.covariance = self.covariance - np.outer(gain, h @ self.covariance)

    def _expected(self) -> tuple[np.ndarray, float]:
        h = np.array([1.0, -FRAME / 2.0])
        return h, float(h @ self.covariance @ h)


def _turn(omega: Samples, delay: float) -> np.ndarray:
    """exp(j omega delay), complex64; several times as fast as np.exp of a complex array."""
    angle, turn = omega * np.float32(delay), np.empty(omega.size, np.complex64)
    np.cos(angle, out=turn.real)
    np.sin(angle, out=turn.imag)
    return turn


def _power(spectrum: np.ndarray) -> Samples:
    return spectrum.real**2 + spectrum.imag**2
