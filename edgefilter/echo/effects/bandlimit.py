"""A codec or a converter passes nothing above its cut-off."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.echo.effect import Measurement, Parameter, Stage, Values
from edgefilter.echo.wiener import convolve_from, fit_filter, spectra
from edgefilter.types import SAMPLE_RATE, Array, Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel

FFT = 1024
TAPS, LEAD = 192, 64
DELAYS = np.arange(-8.0, 8.01, 0.1)
"""Samples: the lag at which a band-limited recording is found is that of its loudest frequencies."""


class Bandlimit:
    """Low-pass with the magnitude of a Butterworth filter, |G|^2 = 1 / (1 + (f / cutoff_hz)^(2 order)).

    phase: 0 for a linear-phase filter (resamplers, codecs), 1 for a minimum-phase one (analogue), the delay at low frequencies taken
    out; delay: what of it a lag found without the filter does not take up.
    taps: (k,) lags -LEAD to k - LEAD, by which the real filter differs from that one.
    """

    name: ClassVar[str] = "bandlimit"
    stage: ClassVar[Stage] = "path"
    memoryless: ClassVar[bool] = False
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("cutoff_hz", "Hz", 16000.0, 200.0, 16000.0),
        Parameter("order", "1", 8.0, 1.0, 60.0),
        Parameter("phase", "1", 0.0, 0.0, 1.0),
        Parameter("delay", "samples", 0.0, -100.0, 100.0),
        Parameter("taps", "1", 0.0, -10.0, 10.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """x without what lies above the cut-off; a cut-off of 16 kHz is none."""
        if float(values["cutoff_hz"]) >= 16000.0:
            return x.copy()
        hz = np.arange(FFT // 2 + 1) * sample_rate / FFT
        response = low_pass(hz, float(values["cutoff_hz"]), float(values["order"]), float(values["phase"]))
        response = response * np.exp(-2j * np.pi * hz / sample_rate * float(values["delay"]))
        y = convolve_from(x, fft.fftshift(fft.irfft(response, FFT)), FFT // 2)
        taps = np.atleast_1d(np.asarray(values["taps"], float))
        return y + convolve_from(x, taps, LEAD) if taps.any() else y

    def fit(self, measurement: Measurement, model: EchoModel) -> Values:
        """The best of a grid of cut-offs, orders and phases, refined, each at its best delay; judged in the whitened cross-spectrum. Then taps."""
        predicted, x = measurement.heard(model)
        found = spectra(measurement, x, 20.0)
        turns = np.exp(-2j * np.pi * np.outer(found.hz, DELAYS) / SAMPLE_RATE)
        turned = found.cross[:, None] * turns.conj()

        def gain(cutoff: float, order: float, phase: float) -> tuple[float, float]:
            response = low_pass(found.hz, cutoff, order, phase)
            along = 2.0 * (response.conj() @ turned).real
            at = int(np.argmax(along))
            return float(along[at] - np.abs(response) ** 2 @ found.predicted), float(DELAYS[at])

        grid = product(np.geomspace(200.0, 7800.0, 60), (1.0, 2.0, 4.0, 8.0, 16.0, 40.0), (0.0, 1.0))
        best = max(grid, key=lambda values: gain(*values)[0])
        step = 1.03
        for _ in range(5):
            near = product(best[0] * np.array([1 / step, 1.0, step]), np.clip(best[1] * np.array([1 / step**3, 1.0, step**3]), 1.0, 60.0), (0.0, 0.5, 1.0))
            best = max(near, key=lambda values: gain(*values)[0])
            step = 1.0 + (step - 1.0) * 0.6
        values = {"cutoff_hz": float(np.clip(best[0], 200.0, 15999.0)), "order": float(best[1]), "phase": float(best[2]), "delay": gain(*best)[1]}
        left = measurement.white_recording - self.apply(x, {**values, "taps": 0.0}, SAMPLE_RATE)
        taps = fit_filter(x, left, measurement.weights, TAPS, LEAD, prior=np.full(TAPS, 1e-3), steps=15)
        return {**values, "taps": np.clip(taps, -10.0, 10.0)}


def low_pass(hz: Array, cutoff: float, order: float, phase: float) -> NDArray[np.complex128]:
    """(m,) complex response; the phase is that of a Butterworth filter less its delay at low frequencies, times `phase`."""
    ratio = hz / cutoff
    magnitude = 1.0 / np.sqrt(1.0 + ratio ** (2.0 * order))
    if phase == 0.0:
        return magnitude.astype(complex)
    poles = np.exp(1j * np.pi * (0.5 + (2 * np.arange(round(order)) + 1) / (2 * round(order))))
    angle = -np.sum(np.angle(1j * ratio[:, None] - poles), axis=1) + np.sum(np.angle(-poles))
    delay = -np.sum((1.0 / poles).real)
    return magnitude * np.exp(1j * phase * (angle + delay * ratio))


def measured_response_db(values: Values) -> tuple[Array, Array]:
    """Frequencies (FFT + 1,) Hz and gain in dB of the filter with its fine taps."""
    impulse = np.zeros(2 * FFT, np.float32)
    impulse[FFT] = 1.0
    response = np.abs(fft.rfft(Bandlimit().apply(impulse, values, SAMPLE_RATE)))
    return np.arange(FFT + 1) * SAMPLE_RATE / (2 * FFT), 20.0 * np.log10(response + 1e-6)
