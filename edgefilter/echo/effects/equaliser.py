"""The voice has another colour: an equaliser in the player, or another loudspeaker."""

from __future__ import annotations

from functools import cache

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.fourier import log_response
from edgefilter.echo.effect import Effect, Parameter, neutral, numbers
from edgefilter.echo.measurement import ORDINARY_DB, Measurement, Values, VoiceModel
from edgefilter.echo.wiener import DELAYS, Spectra, fit_filter, spectra
from edgefilter.types import SAMPLE_RATE, Array, Samples

LOWEST_HZ, HIGHEST_HZ, KNOTS = 80.0, 7600.0, 40
"""A sixth of an octave apart: what is narrower than they can follow rings, and is a resonance."""
FFT = 4096
TAPS, LEAD, EXPECTED = 48, 16, 1e-4
"""Of the filter that takes up what a smooth gain of least phase is not: 3 ms, and a hundredth for each tap."""
BEND = 3e-3
"""Weight of the gain curve's curvature, relative to the largest energy of the signal around one knot of the curve."""
MOST_DB = 40.0


class Equaliser(Effect):
    """y = h * x, |H| smooth over frequency: gain_db at so many knots_hz(), linear in between in dB over the logarithm of frequency.

    Its phase is the least that the gain allows (Oppenheim & Schafer 2010, eq. 12.35), as analogue filters, their
    digital likenesses and loudspeakers have it, but for a delay in samples. taps: (k,) lags -LEAD to k - LEAD, by which
    the real filter differs from that one. range_db only reports: from the least to the largest gain.
    """

    name = "equaliser"
    stage = "path"
    family = "linear path"
    title = "an equaliser or another loudspeaker"
    complexity = 2
    flexible = True
    parameters = (
        Parameter("gain_db", "dB", 0.0, -MOST_DB, MOST_DB),
        Parameter("delay", "samples", 0.0, -100.0, 100.0),
        Parameter("taps", "1", 0.0, -10.0, 10.0),
        Parameter("range_db", "dB", 0.0, 0.0, 2 * MOST_DB),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Put x through the equaliser."""
        gain_db, delay = np.asarray(values["gain_db"], float), float(values["delay"])
        y = x.copy()
        if gain_db.any() or delay:
            gain_db = gain_db if gain_db.size > 1 else np.full(2, gain_db)
            hz = np.arange(FFT // 2 + 1) * sample_rate / FFT
            nepers = _basis(FFT // 2 + 1, sample_rate, gain_db.size) @ (gain_db * (np.log(10.0) / 20.0))
            response = np.exp(nepers - 2j * np.pi * hz / sample_rate * delay)
            y = filtered(x, fft.fftshift(fft.irfft(response, FFT)), FFT // 2)
        return y + filtered(x, numbers(values, "taps"), LEAD)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Levenberg-Marquardt in the gains of all knots and the delay, in the whitened cross-spectrum; then taps. Neutral for a turned volume."""
        x = measurement.predicted(model)[1]
        found = spectra(measurement, model, SAMPLE_RATE / FFT)
        knots, delay = _smooth_gain(found)
        gain_db = np.clip(knots * (20.0 / np.log(10.0)), -MOST_DB, MOST_DB)
        if float(np.std(gain_db)) < ORDINARY_DB:
            return neutral(self)
        values = {"gain_db": gain_db, "delay": delay, "taps": 0.0}
        left = measurement.white_recording - self.apply(x, values, SAMPLE_RATE)
        taps = fit_filter(x, left, measurement.weights, TAPS, LEAD, prior=np.full(TAPS, EXPECTED), steps=20)
        return {**values, "taps": np.clip(taps, -10.0, 10.0), "range_db": float(np.ptp(gain_db))}

    def sentence(self, values: Values) -> str:
        """Where it is loudest and where softest."""
        gain_db = numbers(values, "gain_db")
        hz, high, low = knots_hz(gain_db.size), int(np.argmax(gain_db)), int(np.argmin(gain_db))
        return (
            f"the voice is equalised otherwise than calibrated, smoothly over frequency and alike at all levels: {gain_db[high]:+.1f} dB"
            f" around {hz[high]:.0f} Hz, {gain_db[low]:+.1f} dB around {hz[low]:.0f} Hz"
        )


def knots_hz(count: int) -> Array:
    """So many frequencies, evenly spaced in their logarithm, at which a gain is given, (count,)."""
    return np.geomspace(LOWEST_HZ, HIGHEST_HZ, count)


@cache
def _basis(bins: int, sample_rate: int, knots: int) -> NDArray[np.complex128]:
    """Complex logarithm of the response to a knot of 1 neper, (bins, knots): the gain, and the least phase that goes with it."""
    hz = np.maximum(np.arange(bins) * sample_rate / (2 * (bins - 1)), 1.0)
    at = np.interp(np.log(hz), np.log(knots_hz(knots)), np.arange(knots))
    return log_response(np.maximum(1.0 - np.abs(at[:, None] - np.arange(knots)), 0.0))


def _smooth_gain(found: Spectra) -> tuple[Array, float]:
    """Nepers at the knots (k,) and delay of the response that explains most of the cross-spectrum."""
    delay = float(DELAYS[int(np.argmax(found.earlier(DELAYS)[: found.hz.size].sum(axis=0)))])
    whole = _basis(FFT // 2 + 1, SAMPLE_RATE, KNOTS)
    at = np.clip(np.rint(found.hz * FFT / SAMPLE_RATE).astype(int), 0, FFT // 2)
    basis = np.concatenate((whole[at], -2j * np.pi * found.hz[:, None] / SAMPLE_RATE), axis=1)
    root = np.sqrt(np.maximum(found.predicted, 1e-12))
    stiff = np.sqrt(BEND * float(np.max(root**2 @ np.abs(basis[:, :-1]) ** 2)))
    bends = stiff * np.pad(np.diff(np.eye(KNOTS), 2, axis=0), ((0, 0), (0, 1)))

    def residual(a: Array) -> Array:
        left = root * np.exp(basis @ a) - found.cross / root
        return np.concatenate((left.real, left.imag, bends @ a))

    def slopes(a: Array) -> Array:
        slope = (root * np.exp(basis @ a))[:, None] * basis
        return np.concatenate((slope.real, slope.imag, bends))

    solved = scipy.optimize.least_squares(residual, np.append(np.zeros(KNOTS), delay), slopes, method="lm", ftol=1e-8)
    return solved.x[:-1], float(np.clip(solved.x[-1], -100.0, 100.0))
