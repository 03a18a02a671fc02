"""A part of the robot's body rings, at one frequency or at two."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.lag import turn
from edgefilter.echo.effect import Effect, Parameter, neutral, numbers, within
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.echo.wiener import Spectra, spectra
from edgefilter.types import SAMPLE_RATE, Array, Samples

LOWEST_HZ, HIGHEST_HZ, QUALITIES = 60.0, 7000.0, (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Where modes are looked for."""
SHOWN = 40.0
"""Points of a spectrum within a mode's bandwidth, with which all of the mode shows; the coarse spectrum of 1 Hz has as many from 40 Hz on."""
MODES, NEXT, LEAST_Q = 2, 0.05, 8.0
"""Most resonances that are searched for; least share of the first one's gain that a second one must bring; least Q of each. A
resonance with a lower Q is broader than a fifth of an octave, and the equaliser's knots can follow it."""


class ChassisResonance(Effect):
    """y = x + g Re[e^(i phase) r * x], r(n) = 2 (1 - |z|) z^n, z = exp((2 pi i - pi / q) frequency_hz / rate): a mode excited by the sound.

    gain_db: of the added sound at resonance re the sound itself, 20 log10 g. Each parameter is a number, or an array
    with one for each mode.
    """

    name = "chassis_resonance"
    stage = "path"
    family = "linear path"
    title = "a chassis resonance"
    complexity = 1
    parameters = (
        Parameter("frequency_hz", "Hz", 1000.0, 20.0, 8000.0),
        Parameter("q", "1", 30.0, 0.5, 2000.0),
        Parameter("gain_db", "dB", -120.0, -120.0, 60.0),
        Parameter("phase_deg", "degrees", 0.0, -180.0, 180.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        y = x.copy()
        for frequency, q, gain_db, phase in np.broadcast(*(numbers(values, p.name) for p in self.parameters)):
            if gain_db > -120.0:
                gain = 10.0 ** (gain_db / 20.0) * np.exp(1j * np.deg2rad(phase))
                y += (gain * _ring(x, frequency, q, sample_rate)).real.astype(np.float32)
        return y

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Frequency and Q by a search in the whitened cross-spectrum, gain and phase by least squares; if it pays, another mode.

        Neutral where what is found is too broad for a mode, or cut off by the search's bounds.
        """
        predicted, white = measurement.predicted(model)
        coarse = spectra(measurement, model, 1.0)
        residual = measurement.white_recording - white
        modes: list[tuple[float, float]] = []
        columns, gains, explained = np.zeros((white.size, 0), np.float32), np.zeros(0), 0.0
        for _ in range(MODES):
            frequency, q = _search(_without(coarse, modes, gains))
            fine = spectra(measurement, model, min(frequency / q / SHOWN, 1.0))
            mode = _refine(_without(fine, modes, gains), frequency, q)
            if mode[1] < LEAST_Q or not LOWEST_HZ < mode[0] < HIGHEST_HZ:
                break
            ring = _ring(predicted, *mode, SAMPLE_RATE)
            added = [measurement.whiten(part.astype(np.float32)) for part in (ring.real, -ring.imag)]
            tried = np.concatenate((columns, np.stack(added, axis=1) * measurement.weights[:, None]), axis=1)
            right = (tried.T @ residual).astype(float)
            solved = np.linalg.lstsq((tried.T @ tried).astype(float), right, rcond=1e-12)[0]
            if modes and float(solved @ right) < (1.0 + NEXT) * explained:
                break
            modes, columns, gains, explained = [*modes, mode], tried, solved, float(solved @ right)
        if not modes:
            return neutral(self)
        complex_gains = gains[::2] + 1j * gains[1::2]
        level = 20.0 * np.log10(np.maximum(np.abs(complex_gains), 1e-6))
        found = np.array([*zip(*modes, strict=True), level, np.rad2deg(np.angle(complex_gains))])[:, np.argsort(-level)]
        rows = {p.name: row if row.size > 1 else row[0] for p, row in zip(self.parameters, found, strict=True)}
        return within(self, rows)

    def sentence(self, values: Values) -> str:
        both = zip(numbers(values, "frequency_hz"), numbers(values, "q"), strict=True)
        modes = [f"{hz:.0f} Hz with Q {q:.0f}" for hz, q in both]
        where = "one frequency" if len(modes) == 1 else "two frequencies"
        return f"the residual rings at {where}, {' and '.join(modes)}, whenever the voice excites it"


def _without(found: Spectra, modes: list[tuple[float, float]], gains: Array) -> Spectra:
    """The spectra with what modes of these gains (2 modes,), real and imaginary, explain taken out of the cross-spectrum."""
    cross = found.cross
    for (frequency, q), real, imaginary in zip(modes, gains[::2], gains[1::2], strict=True):
        cross = cross - (real + 1j * imaginary) * _shape(found.hz, np.array([frequency]), q)[0] * found.predicted
    return replace(found, cross=cross)


def _pole(frequency: float | Array, q: float | Array, sample_rate: int) -> complex | NDArray[np.complex128]:
    return np.exp((2j * np.pi - np.pi / np.asarray(q)) * np.asarray(frequency) / sample_rate)


def _ring(x: Samples, frequency: float, q: float, sample_rate: int) -> NDArray[np.complex128]:
    """The mode's response r * x, (n,) complex."""
    pole = complex(_pole(frequency, q, sample_rate))
    return scipy.signal.lfilter([2.0 * (1.0 - abs(pole))], [1.0, -pole], x.astype(complex))


def _shape(hz: Array, frequency: Array, q: float) -> NDArray[np.complex128]:
    """Response of the mode at positive frequencies (its image at negative ones is left out), (modes, m)."""
    pole = np.asarray(_pole(frequency, q, SAMPLE_RATE))
    return (1.0 - np.abs(pole))[:, None] / (1.0 - pole[:, None] * turn(hz, -2.0 * np.pi / SAMPLE_RATE))


def _explained(found: Spectra, hz_slice: slice, frequency: Array, q: float) -> Array:
    """Squared error that each mode with its best complex gain takes away, (modes,)."""
    shape = _shape(found.hz[hz_slice], frequency, q)
    left = found.cross[hz_slice] - found.predicted[hz_slice]
    return np.abs(shape.conj() @ left) ** 2 / np.maximum((np.abs(shape) ** 2) @ found.predicted[hz_slice], 1e-12)


def _search(found: Spectra) -> tuple[float, float]:
    best = (0.0, 1000.0, 30.0)
    for q in QUALITIES:
        for low in np.geomspace(LOWEST_HZ, HIGHEST_HZ, 33)[:-1]:
            high = low * (HIGHEST_HZ / LOWEST_HZ) ** (1 / 32)
            frequency = np.geomspace(low, high, max(int(2 * q * np.log(high / low)), 2))
            reach = max(6.0 / q, 0.1)
            inside = slice(*np.searchsorted(found.hz, (low * (1 - reach), high * (1 + reach))))
            gain = _explained(found, inside, frequency, q)
            k = int(np.argmax(gain))
            best = max(best, (float(gain[k]), float(frequency[k]), q))
    return best[1], best[2]


def _refine(found: Spectra, frequency: float, q: float) -> tuple[float, float]:
    width = 8.0 * frequency / q + 20.0
    inside = slice(*np.searchsorted(found.hz, (frequency - width, frequency + width)))

    def moved(v: Array) -> tuple[float, float]:
        hz, quality = frequency * np.exp(v[0] / q), q * np.exp(v[1])
        return float(np.clip(hz, LOWEST_HZ, HIGHEST_HZ)), float(np.clip(quality, 4.0, 2000.0))

    def cost(v: Array) -> float:
        hz, quality = moved(v)
        return -float(_explained(found, inside, np.array([hz]), quality)[0])

    options = {"maxiter": 60, "initial_simplex": [[0, 0], [0.5, 0], [0, 0.5]]}
    return moved(scipy.optimize.minimize(cost, [0.0, 0.0], method="Nelder-Mead", options=options).x)
