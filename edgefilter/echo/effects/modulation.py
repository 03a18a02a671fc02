"""A gain that moves with time by itself, again and again: a tremolo, blades in front of a loudspeaker, a contact that shakes."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from edgefilter.dsp.frames import blocks
from edgefilter.echo.effect import Effect, Parameter, Runner, Stage, as_array, neutral
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

STEP = 16
"""Samples (1 ms) over which the gain is taken for constant."""
LOWEST_HZ, HIGHEST_HZ = 0.5, 150.0
"""Slower is a drift of the gain; faster is heard as a tone of its own."""
HARMONICS = 4
FINER = 24
"""Rates tried per cycle in the whole recording."""
CLIMB = 0.2
"""Step of the follower on a stream, of a normalised gradient per hop."""
FORGET = 0.95
"""Share of a hop's energy that the follower remembers at the next."""


class Modulation(Effect):
    """y(t) = g (1 + sum over h of cosine_h cos(2 pi h f t) + sine_h sin(2 pi h f t)) x(t), f the rate.

    rate_hz: f. mean_db: 20 log10 g. cosine, sine: (harmonics,). The rate is the robot's, the phase that of one recording.
    """

    name: ClassVar[str] = "modulation"
    stage: ClassVar[Stage] = "path"
    family: ClassVar[str] = "modulation"
    title: ClassVar[str] = "a gain that moves with time"
    event: ClassVar[bool] = True
    run_note: ClassVar[str] = "its phase is of this recording; the running filter follows it at the rate found here"
    complexity: ClassVar[int] = 2
    flexible: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("rate_hz", "Hz", 5.0, 0.1, 1000.0),
        Parameter("mean_db", "dB", 0.0, -40.0, 40.0),
        Parameter("cosine", "1", 0.0, -2.0, 2.0),
        Parameter("sine", "1", 0.0, -2.0, 2.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """X (n,) times the gain of each moment."""
        weights, mean = _weights(values), 10.0 ** (float(values["mean_db"]) / 20.0)
        angle = 2.0 * np.pi * float(values["rate_hz"]) * np.arange(x.size) / sample_rate
        return (x * (mean * (1.0 + weights @ waves(angle, weights.size // 2)))).astype(np.float32)

    def run(self, values: Values, sample_rate: int) -> Runner | None:
        """A follower of the phase at that rate; none where nothing moves."""
        return Follower(values, sample_rate) if _weights(values).any() else None

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The rate at which a gain of one harmonic explains most, then all harmonics, by least squares."""
        voice, recording = measurement.heard(model)[1], measurement.white_recording
        energy, cross = (
            blocks(voice * other * measurement.weights, STEP).sum(axis=1, dtype=np.float64)
            for other in (voice, recording)
        )
        if not energy.any():
            return neutral(self)
        rates, worth, _ = by_rate(energy, cross, LOWEST_HZ, HIGHEST_HZ)
        rate = float(rates[int(np.argmax(worth))])
        angle = 2.0 * np.pi * rate * STEP / SAMPLE_RATE * (np.arange(energy.size) + 0.5)
        rows = np.concatenate((np.ones((1, energy.size)), waves(angle, HARMONICS)))
        matrix = (rows * energy) @ rows.T
        found = np.linalg.solve(matrix + 1e-9 * np.trace(matrix) * np.eye(len(rows)), rows @ cross)
        weights = np.clip(found[1:] / (found[0] or 1.0), -2.0, 2.0)
        mean_db = 20.0 * np.log10(np.clip(found[0], 0.01, 100.0))
        return {"rate_hz": rate, "mean_db": float(mean_db), "cosine": weights[:HARMONICS], "sine": weights[HARMONICS:]}

    def sentence(self, values: Values) -> str:
        """How fast, and by how much."""
        weights = _weights(values)
        gain = 1.0 + weights @ waves(np.linspace(0.0, 2.0 * np.pi, 256), weights.size // 2)
        high, low = (20.0 * np.log10(max(abs(float(end)), 1e-2)) for end in (gain.max(), gain.min()))
        return f"the gain moves between {low:.1f} and {high:+.1f} dB, {float(values['rate_hz']):.2f} times a second"

    def code(self, values: Values) -> str:
        """The gain of each moment of this recording."""
        cosine, sine = _weights(values).reshape(2, -1)
        return f"""RATE_HZ, MEAN = {float(values["rate_hz"]):.4f}, {10.0 ** (float(values["mean_db"]) / 20.0):.4f}
COSINE = {as_array(cosine, 4)}
SINE = {as_array(sine, 4)}


def law(x, sample_rate):
    angle = 2 * np.pi * RATE_HZ * np.arange(x.size) / sample_rate
    waves = [c * np.cos(h * angle) + s * np.sin(h * angle) for h, (c, s) in enumerate(zip(COSINE, SINE), 1)]
    return MEAN * (1 + np.sum(waves, axis=0)) * x"""


class Follower:
    """The modulation on a stream: values as of Modulation, its phase learned from what the microphone hears."""

    def __init__(self, values: Values, sample_rate: int) -> None:
        self._turn = 2.0 * np.pi * float(values["rate_hz"]) / sample_rate
        self._mean = 10.0 ** (float(values["mean_db"]) / 20.0)
        self._weights = np.zeros(_weights(values).size)
        self._at, self._energy = 0, 0.0

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        """X (n,) times the gain as it is known by now."""
        columns = waves(self._turn * (self._at + np.arange(x.size)), self._weights.size // 2) * (self._mean * x)
        self._at += x.size
        y = (self._mean * x + self._weights @ columns).astype(np.float32)
        if heard is not None:
            self._energy = max(FORGET * self._energy, self._mean**2 * float(x @ x))
            self._weights = self._weights + CLIMB * (columns @ (heard - y)) / (self._energy + 1e-9)
        return y


def waves(angle: Array, harmonics: int) -> Array:
    """(2 harmonics, n) cosines, then sines, of an angle (n,) and its multiples."""
    turned = np.arange(1, harmonics + 1)[:, None] * angle
    return np.concatenate((np.cos(turned), np.sin(turned)))


def _weights(values: Values) -> Array:
    """(2 harmonics,) cosines, then sines, as many of either."""
    cosine, sine = (np.ravel(values[name]).astype(float) for name in ("cosine", "sine"))
    longer = max(cosine.size, sine.size)
    return np.concatenate([np.pad(part, (0, longer - part.size)) for part in (cosine, sine)])


def by_rate(energy: Array, cross: Array, lowest_hz: float, highest_hz: float) -> tuple[Array, Array, Array]:
    """Of each rate (k,) in Hz the energy that a gain 1 + a cos + b sin at it explains, (k,), and its depth, (k,).

    From sums of voice times voice, and voice times recording, per step.
    """
    size = FINER * energy.size
    per = SAMPLE_RATE / STEP / size
    own, other = np.fft.rfft(energy, size), np.fft.rfft(cross, size)
    rates = np.arange(max(round(lowest_hz / per), 1), min(round(highest_hz / per), own.size // 2))
    at, twice, seen = own[rates], own[2 * rates], other[rates]
    matrix = np.empty((rates.size, 3, 3))
    matrix[:, 0, 0] = own[0].real
    matrix[:, 0, 1] = matrix[:, 1, 0] = at.real
    matrix[:, 0, 2] = matrix[:, 2, 0] = -at.imag
    matrix[:, 1, 1], matrix[:, 2, 2] = 0.5 * (own[0] + twice).real, 0.5 * (own[0] - twice).real
    matrix[:, 1, 2] = matrix[:, 2, 1] = -0.5 * twice.imag
    right = np.stack((np.full(rates.size, other[0].real), seen.real, -seen.imag), axis=1)
    matrix += (1e-6 * own[0].real + 1e-30) * np.eye(3)
    found = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    depth = np.hypot(found[:, 1], found[:, 2]) / np.maximum(np.abs(found[:, 0]), 1e-6)
    return rates * per, np.sum(found * right, axis=1), depth
