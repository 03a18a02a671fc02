"""The device behind the microphone suppresses noise: fan and voice are let through as far as the voice stands out of the fan."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from edgefilter.dsp.frames import decibels, frames
from edgefilter.dsp.psd import floored, frequencies, hann, variance_at
from edgefilter.echo.effect import Effect, Parameter, Runner, first, neutral, numbers, within
from edgefilter.echo.least_squares import hats
from edgefilter.echo.measurement import SILENT, Measurement, Values, VoiceModel
from edgefilter.types import Array, Samples

SIZE, HOP = 512, 256
WINDOW = np.sqrt(hann(SIZE))
"""Frames of 32 ms. Analysis and synthesis: their product, half-overlapping, adds up to 1."""
FORGETTING, NEIGHBOURS = 0.5, 3
"""Of the local ratio, from frame to frame, and the bins over which it is averaged: what explains most of the suppressors tried."""
KNOTS_DB = np.arange(-10.0, 31.0, 5.0)
"""Knots of the gain curve: ratio of voice to fan in a cell, dB. The gain is 1 from the last knot on, that of the fan alone up to -20 dB."""
LOUD_DB = 15.0
"""Where a suppressor lets nearly all through."""
TRUST = 0.3
"""Standard deviation of a gain around that of the next knot, the last one's around 1, before anything was heard."""
EDGES = np.unique(np.round(np.geomspace(4, SIZE // 2 - 10, 17)).astype(int))
"""Bins of the bands whose loud cells say what the path is off by."""
FEWEST_LOUD, FEWEST_QUIET = 30, 16
"""Cells of a band, and frames of silence, that say something."""
LEAST_SOFTER_DB = 2.0
"""By which the silences are under the calibrated fan at least, from day to day it is half a dB, and by which the weakest
voice is let through less: behind a softer fan that is as predicted to half a dB."""


class NoiseSuppression(Effect):
    """Y(f, t) = g(r) X(f, t), r the local ratio |X|^2 / N of the predicted voice to the calibrated fan, in frames of 32 ms.

    Every suppressor of the family of Wiener's filter (Lim & Oppenheim 1979, Ephraim & Malah 1984, and the spectral
    gates) is a gain that rises with the local ratio, and differs in how steeply; so that is fitted: gain_db (8,) at ratios
    of -10 to 25 dB, 0 dB from 30 dB on. fan_db: (601,) dB re full scale^2/Hz, the calibrated fan on which the ratio is
    formed, or one number. softer_db: the gain of the fan alone, level of the robot's silences re the calibrated one.
    """

    name = "noise_suppression"
    stage = "microphone"
    family = "dynamics"
    run_note = (
        "what it takes of the voice lies near the fan, and where it opens it lets the calibrated fan through: adding it"
        " changes nothing in the running filter"
    )
    title = "noise suppression"
    complexity = 2
    parameters = (
        Parameter("gain_db", "dB", 0.0, -60.0, 12.0),
        Parameter("fan_db", "dB re full scale^2/Hz", -200.0, -200.0, 0.0, given=True),
        Parameter("softer_db", "dB", 0.0, -120.0, 60.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        return self.passed(x, x, values, sample_rate)

    def passed(self, noise: Samples, voice: Samples, values: Values, sample_rate: int) -> Samples:
        gain_db = numbers(values, "gain_db", KNOTS_DB.size - 1)
        if not gain_db.any() or not noise.size:
            return noise.copy()
        density = 10.0 ** (numbers(values, "fan_db") / 10.0)
        fan = variance_at(frequencies(SIZE // 2 + 1), np.resize(density, 601).astype(np.float32))
        spectra = _spectra(np.pad(noise, (HOP, SIZE)))
        own = spectra if voice is noise else _spectra(np.pad(voice, (HOP, SIZE)))
        gain_db = np.array([first(values, "softer_db"), *gain_db, 0.0])
        spectra *= np.interp(decibels(_ratio(own, fan)), (2.0 * KNOTS_DB[0], *KNOTS_DB), 10.0 ** (gain_db / 20.0))
        pieces = np.fft.irfft(spectra, SIZE) * WINDOW
        whole = np.zeros((pieces.shape[0] + 1, HOP))
        whole[:-1] += pieces[:, :HOP]
        whole[1:] += pieces[:, HOP:]
        return whole.ravel()[HOP : HOP + noise.size].astype(np.float32)

    def run(self, values: Values, sample_rate: int) -> Runner:
        """The voice as it is: a gain by frequency takes as long as a frame, which the running filter does not wait."""
        return lambda x, heard=None: x

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Gains at the knots, relative to those of the band's loud cells, by least squares over cells in which the fan has a variance of 1.

        Neutral, 0 dB everywhere, where silences and weak voice are not softer than calibrated.
        """
        if measurement.noise_psd is None:
            return neutral(self)
        voice = measurement.predicted(model)[0]
        quiet_db, (ratio_db, power, cross) = _cells(measurement, measurement.noise_psd, voice)
        if quiet_db > -LEAST_SOFTER_DB:
            return neutral(self)
        *parts, last = hats(ratio_db, KNOTS_DB)
        knots = len(parts)
        step, right = (np.eye(knots) - np.eye(knots, k=1)) / TRUST, parts @ (cross - last * power)
        right[-1] += TRUST**-2
        left = step.T @ step + (parts * power) @ np.transpose(parts)
        gain_db = 20.0 * np.log10(np.clip(np.linalg.solve(left, right), 1e-3, 3.9))
        if gain_db[0] > -LEAST_SOFTER_DB:
            return neutral(self)
        fan_db = 10.0 * np.log10(floored(measurement.noise_psd))
        return within(self, {"gain_db": gain_db, "fan_db": fan_db, "softer_db": quiet_db})

    def sentence(self, values: Values) -> str:
        at = dict(zip(KNOTS_DB.astype(int).tolist(), numbers(values, "gain_db", KNOTS_DB.size - 1), strict=False))
        return (
            f"while the robot is silent the fan is {-first(values, 'softer_db'):.0f} dB softer than calibrated, and of the"
            f" voice less is let through the less it stands out of the fan: {at[-5]:.0f} dB at -5 dB over it, {at[5]:.0f}"
            f" dB at 5 dB, {at[15]:.0f} dB at 15 dB, all of it where it is loud"
        )


def _cells(measurement: Measurement, noise_psd: Samples, voice: Samples) -> tuple[float, Array]:
    """Level of the recording while the robot is silent, 0 where that is too seldom; of the cells to fit to three figures, (3, cells).

    The ratio of voice to fan in dB, and, the fan's power in each taken as 1, the power of the voice as loud cells of its
    band have it, and the product of that voice and the recording, real part.
    """
    fan = variance_at(frequencies(SIZE // 2 + 1), floored(noise_psd))
    whole = frames(measurement.weights, SIZE, HOP).all(axis=1)
    x, y = (_spectra(signal) for signal in (voice, measurement.recording))
    local_db = decibels(_ratio(x, fan)[whole])
    x, y = (spectra / np.sqrt(HOP * fan) for spectra in (x, y))
    quiet_db = _quiet_db(x, y)
    x, y = x[whole], y[whole]
    found = [np.zeros((3, 0))]
    for low, high in pairwise(EDGES):
        own, both = np.abs(x[:, low:high]) ** 2, (np.conj(x[:, low:high]) * y[:, low:high]).real
        level = local_db[:, low:high]
        loud = level > LOUD_DB
        scale = float(both[loud].sum() / own[loud].sum()) if loud.sum() >= FEWEST_LOUD else 0.0
        if scale > 0.0:
            found.append(np.stack((level.ravel(), scale**2 * own.ravel(), scale * both.ravel())))
    return quiet_db, np.concatenate(found, axis=1)


def _quiet_db(x: NDArray[np.complex128], y: NDArray[np.complex128]) -> float:
    """Level of the recording y where the voice x is SILENT: of a median, so that somebody who talks now and then is not heard."""
    inner = slice(EDGES[0], EDGES[-1])
    silent = np.mean(np.abs(x[:, inner]) ** 2, axis=1) < SILENT
    if np.count_nonzero(silent) < FEWEST_QUIET:
        return 0.0
    return float(decibels(np.median(np.abs(y[silent, inner]) ** 2) / np.log(2.0)))


def _ratio(spectra: NDArray[np.complex128], fan: Array) -> Array:
    """The local ratio of the spectra to the fan, (frames, bins); fan: (bins,) density per sample."""
    near = uniform_filter1d(np.abs(spectra) ** 2, NEIGHBOURS, axis=1, mode="nearest")
    return scipy.signal.lfilter([1.0 - FORGETTING], [1.0, -FORGETTING], near, axis=0) / (HOP * fan)


def _spectra(x: Samples) -> NDArray[np.complex128]:
    """Short-time spectra, (frames, SIZE / 2 + 1) complex."""
    return np.fft.rfft(frames(x, SIZE, HOP) * WINDOW)
