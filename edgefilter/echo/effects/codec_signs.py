"""What tells a codec's noise from all else that follows the voice: it follows its level and has neither its phase nor harmonics."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter, uniform_filter1d

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.fourier import power as power_of
from edgefilter.dsp.frames import decibels, frames
from edgefilter.dsp.psd import hann
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.wiener import fit_filter
from edgefilter.types import Samples

TAPS, LEAD = 256, 64
"""Taps of the filter by which the path may differ from the calibrated one or a codec cuts the band, and those before its centre."""
SHORT, LONG = (512, 128), (1024, 256)
"""Frame and hop, for what is coherent with the voice and for harmonics."""
PLACES = ((7, 15), (13, 7), (3, 41))
"""Frames of 8 ms and bins of 31 Hz around a cell within which a change of the voice is one complex gain: a path that moves, a
gain that changes, a clock that trembles."""
SHIFTS, SHIFTED = range(3, 17), (1, 41)
"""Bins by which a sound that is modulated comes back beside itself, either way, and the place around a cell for that."""
HEARD = 2.0
"""Times the fan that the residual around a cell, or the voice, must have to say something."""
FOLLOWS = 0.4
"""Correlation, over time in bands, of the residual's level with the voice's: what sounds by itself has none, knocks less than
0.35."""
COHERENT = 0.24
"""Of the residual's power around a cell, what one gain of the voice explains at most: chance is 0.05, codecs are up to 0.22,
distortions from 0.25 on and all that moves from 0.4 on."""
PEAKED = 1.39
"""Standard deviation of the log of the residual's fine structure over frequency, at most: 1.1 of noise, of a loudspeaker's
distortion, which has the voice's harmonics, 1.45 and more (72 pieces of a real one), of nine codecs in ten below 1.34."""
AROUND = 17
"""Bins of 16 Hz over which that is smoothed."""


def is_codec(measurement: Measurement, voice: Samples) -> bool:
    """Whether what is left beside the voice (n,), whitened, as a model predicts it, is a codec's; a linear path of its own is taken out.

    It follows the voice's level (FOLLOWS), and has neither its phase (COHERENT) nor its harmonics (PEAKED).
    """
    left = measurement.white_recording - voice
    taps = fit_filter(voice, left, measurement.weights, TAPS, LEAD, prior=np.full(TAPS, 1e-3), steps=15)
    fine = filtered(voice, taps, LEAD)
    voice, left = voice + fine, left - fine
    heard = (measurement.weights > 0.0) & (uniform_filter1d(voice * voice, LONG[0]) > HEARD)
    cells = _spectra(voice, *SHORT), _spectra(left, *SHORT), _whole(heard, *SHORT)
    return _follows(*cells) > FOLLOWS and _coherent(*cells) < COHERENT and _peaked(left, heard) < PEAKED


def _spectra(x: Samples, size: int, hop: int) -> NDArray[np.complex64]:
    window = hann(size).astype(np.float32)
    return scipy.fft.rfft(frames(x, size, hop) * (window / np.sqrt(np.sum(window**2))), axis=1)[
        :, size // 128 : -size // 128
    ]


def _whole(heard: NDArray[np.bool_], size: int, hop: int) -> NDArray[np.bool_]:
    """Whether the voice is heard in nearly all of each, (frames,)."""
    return frames(heard.astype(np.float32), size, hop).mean(axis=1) > 0.9


def _follows(said: NDArray[np.complex64], rest: NDArray[np.complex64], whole: NDArray[np.bool_]) -> float:
    """Correlation of the levels of both (frames, bins) in dB, within bands over time, where both are over the fan."""
    edges = np.unique(np.geomspace(1, SHORT[0] // 2 - 12, 16).astype(int))
    over, loud = (
        np.add.reduceat(uniform_filter(power_of(spectra), (5, 1)), edges[:-1], axis=1)[:, :-1] / np.diff(edges)[:-1]
        for spectra in (rest, said)
    )
    use = whole[:, None] & (over > HEARD) & (loud > HEARD)
    count = np.maximum(use.sum(axis=0), 1)
    swings = []
    for level in (decibels(np.maximum(over - 1.0, 0.1)), decibels(np.maximum(loud, 0.1))):
        swings.append(use * (level - (use * level).sum(axis=0) / count))
    a, b = swings
    return float(np.sum(a * b) / np.sqrt(np.sum(a * a) * np.sum(b * b) + 1e-12))


def _coherent(said: NDArray[np.complex64], rest: NDArray[np.complex64], use: NDArray[np.bool_]) -> float:
    """The most that one gain of the voice around each cell explains of the residual's power: over PLACES, or shifted by one of SHIFTS."""
    most = max(_explained(said, rest, use, place) for place in PLACES)
    said, rest, use = said[::4], rest[::4], use[::4]
    for by in SHIFTS:
        for pair in ((said[:, :-by], rest[:, by:]), (said[:, by:], rest[:, :-by])):
            most = max(most, _explained(*pair, use, SHIFTED))
    return most


def _explained(
    said: NDArray[np.complex64], rest: NDArray[np.complex64], use: NDArray[np.bool_], place: tuple[int, int]
) -> float:
    """Of the power of rest (frames, bins) in those frames, what one gain of said around each cell explains."""
    cross, power, over = said.conj() * rest, power_of(said), power_of(rest)
    along = uniform_filter(cross.real, place) ** 2 + uniform_filter(cross.imag, place) ** 2
    around = uniform_filter(over, place)
    cells = use[:, None] & (around > HEARD)
    explained = along / (uniform_filter(power, place) + np.float32(1e-9))
    return float(explained[cells].sum()) / max(float(around[cells].sum()), 1e-9)


def _peaked(left: Samples, heard: NDArray[np.bool_]) -> float:
    """Standard deviation of the log of the residual's (n,) fine structure over frequency, where the voice is heard."""
    power = power_of(_spectra(left, *LONG))[:, : LONG[0] * 3 // 16]
    log = np.log(power + 1e-6)
    use = _whole(heard, *LONG)[:, None] & (uniform_filter1d(power, AROUND, axis=1) > 2.0 * HEARD)
    fine = (log - uniform_filter1d(log, AROUND, axis=1)) * use
    return float(np.sqrt(np.sum(fine * fine) / max(np.count_nonzero(use), 1)))
