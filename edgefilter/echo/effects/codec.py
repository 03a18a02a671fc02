"""A lossy codec ahead of the loudspeaker: it adds noise that follows the voice and is missing in the reference."""

from __future__ import annotations

from itertools import chain, product

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter, uniform_filter1d

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.fourier import power as power_of
from edgefilter.dsp.frames import decibels, frames, stretch
from edgefilter.dsp.psd import hann
from edgefilter.echo.effect import Effect, Parameter, first, neutral, numbers, within
from edgefilter.echo.effects.bandlimit import LEAD, short_filter
from edgefilter.echo.effects.knock_power import (
    BANDS,
    FRAME,
    HOP,
    band_power,
    colour_of,
    density_of,
    fan_in_bands,
    frames_to_fit,
)
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

DECAYS_MS, EXPONENTS = (4.0, 8.0, 16.0, 32.0), (0.5, 0.7, 1.0)
"""Tried, by likelihood: a codec's frames and the room; and how the noise grows with the voice."""
CLEAR, STANDS_OUT = 30.0, 1.25
"""Times the fan that the voice must be in a band for its noise to be expected there, and that the residual must be in the median
one of these bands: what happens in a narrow band alone is no codec's."""
SHORT, LONG = 512, 1024
"""Samples of a frame, for what is coherent with the voice and for harmonics; four begin in one."""
PLACES = ((7, 15), (13, 7), (3, 41))
"""Frames of 8 ms and bins of 31 Hz around a cell within which a change of the voice is one complex gain: a path that moves, a
gain that changes, a clock that trembles."""
SHIFTS, SHIFTED = range(3, 17), (1, 41)
"""Bins between a sound and its sidebands where it is modulated, on either side; and the frames and bins around a cell for that
comparison."""
HEARD = 2.0
"""Times the fan that the residual around a cell, or the voice, must have to say something."""
FOLLOWS = 0.4
"""Correlation, over time in bands, of the residual's level with the voice's: what sounds by itself has none, knocks less than
0.35."""
COHERENT = 0.24
"""Largest share of the residual's power around a time-frequency cell that one complex gain of the voice may explain where the residual
counts as a codec's noise: noise has 0.05, codecs up to 0.22, distortions from 0.25 on, changes over time from 0.4 on."""
PEAKED = 1.39
"""Standard deviation of the log of the residual's fine structure over frequency, at most: 1.1 of noise, of a loudspeaker's
distortion, which has the voice's harmonics, 1.45 and more (72 pieces of a real one), of nine codecs in ten below 1.34."""
AROUND = 17
"""Bins of 16 Hz over which that is smoothed."""


class Codec(Effect):
    """Expected square of the noise at the microphone, in each band of 500 Hz: power * level^exponent.

    level is the power of the reference in that band, decaying by 1/e in decay_ms. A codec spends its bits where the ear
    would hear the noise, so that this follows the voice in each band (Brandenburg & Bosi 1997, "Overview of MPEG audio:
    current and future standards for low-bit-rate audio coding"), yet has none of its phase: no waveform predicts it.
    power: (16,). below_voice_db, noise re voice at the microphone, only reports. What the codec takes away of the band
    is a `bandlimit` beside it.
    """

    name = "codec"
    stage = "source"
    family = "additive noise"
    run_note = "the running filter follows by itself what noise the voice brings along: adding it changes nothing there"
    title = "a codec"
    followed = True
    parameters = (
        Parameter("power", "full scale^2", 0.0, 0.0, 1e3),
        Parameter("decay_ms", "ms", 8.0, 0.1, 100.0),
        Parameter("exponent", "1", 1.0, 0.1, 2.0),
        Parameter("below_voice_db", "dB", 0.0, -60.0, 200.0),
    )

    def variance(self, reference: Samples, values: Values, sample_rate: int) -> Samples:
        """What the noise adds to the expected square of each sample at the microphone, band by band, for an aligned reference (n,); (16, n)."""
        power = numbers(values, "power", BANDS)
        frames = power * _levels(reference, float(values["decay_ms"])) ** float(values["exponent"])
        spread = np.repeat(frames.T.astype(np.float32), HOP, axis=1)
        return np.pad(spread, ((0, 0), (FRAME // 2, reference.size)), mode="edge")[:, : reference.size]

    def colour(self, values: Values) -> Array:
        """The spectral density of each band, (16, 601), 0 to 8 kHz, per Hz: its integral is 1."""
        return np.stack([density_of(band) for band in np.eye(BANDS)])

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Maximum likelihood of the residual's power in cells, as for a rattle's, for each decay and exponent.

        Neutral where the fan is unknown, nothing is left over it, or what is left does not follow the voice as a codec's noise.
        """
        if measurement.noise_psd is None:
            return neutral(self)
        predicted, target = measurement.predicted(model)[1], measurement.white_recording
        over, voice = band_power(target - predicted), band_power(predicted)
        use = frames_to_fit(measurement.fit, len(over))
        loud = use & (voice.mean(axis=1) > HEARD)
        clear = voice[loud].mean(axis=0) > CLEAR if loud.any() else np.zeros(BANDS, bool)
        stands_out = clear.any() and np.median(over[loud].mean(axis=0)[clear]) >= STANDS_OUT
        if not (stands_out and _is_codec(measurement, predicted)):
            return neutral(self)
        levels = {decay: _levels(measurement.reference, decay) for decay in DECAYS_MS}
        tried = [
            (*colour_of(over, levels[decay] ** exponent, use), decay, exponent)
            for decay, exponent in product(DECAYS_MS, EXPONENTS)
        ]
        _, power, decay, exponent = max(tried, key=lambda entry: entry[0])
        below = decibels(float(np.mean(voice[loud]))) - decibels(
            float(np.mean(np.maximum(over[loud] - 1.0, 0.0))) + 1e-9
        )
        power = power * fan_in_bands(measurement.noise_psd)
        return within(self, {"power": power, "decay_ms": decay, "exponent": exponent, "below_voice_db": below})

    def sentence(self, values: Values) -> str:
        return (
            f"noise {first(values, 'below_voice_db'):.0f} dB below the voice follows it in every band, but neither its phase nor"
            " its harmonics: what a codec leaves, and no waveform predicts; it is shown as irreducible"
        )


def _levels(x: Samples, decay_ms: float) -> Array:
    """Power of x (n,) in each band, decaying by 1/e in decay_ms, as late as the direct sound, (frames, BANDS)."""
    keep = np.exp(-HOP / (decay_ms * 1e-3 * SAMPLE_RATE))
    heard = band_power(stretch(x, -PRE_ROLL, x.size - PRE_ROLL))
    return np.maximum(scipy.signal.lfilter([1.0 - keep], [1.0, -keep], heard, axis=0), 1e-12)


def _is_codec(measurement: Measurement, voice: Samples) -> bool:
    """Whether what is left beside the voice (n,), whitened, as a model predicts it, is a codec's; a linear path of its own is taken out.

    It follows the voice's level (FOLLOWS), and has neither its phase (COHERENT) nor its harmonics (PEAKED).
    """
    left = measurement.white_recording - voice
    fine = filtered(voice, short_filter(voice, left, measurement.weights), LEAD)
    voice, left = voice + fine, left - fine
    heard = (measurement.weights > 0.0) & (uniform_filter1d(voice * voice, LONG) > HEARD)
    cells = _spectra(voice, SHORT), _spectra(left, SHORT), _whole(heard, SHORT)
    return _follows(*cells) > FOLLOWS and _peaked(left, heard) < PEAKED and not _coherent(*cells)


def _spectra(x: Samples, size: int) -> NDArray[np.complex64]:
    window = hann(size).astype(np.float32)
    window /= np.sqrt(np.sum(window**2))
    return scipy.fft.rfft(frames(x, size, size // 4) * window, axis=1)[:, size // 128 : -size // 128]


def _whole(heard: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    """Whether the voice is heard in nearly all of each, (frames,)."""
    return frames(heard.astype(np.float32), size, size // 4).mean(axis=1) > 0.9


def _follows(said: NDArray[np.complex64], rest: NDArray[np.complex64], whole: NDArray[np.bool_]) -> float:
    """Correlation of the levels of both (frames, bins) in dB, within bands over time, where both are over the fan."""
    edges = np.unique(np.geomspace(1, SHORT // 2 - 12, 16).astype(int))
    over, loud = (
        np.add.reduceat(uniform_filter(power_of(spectra), (5, 1)), edges[:-1], axis=1)[:, :-1] / np.diff(edges)[:-1]
        for spectra in (rest, said)
    )
    use = whole[:, None] & (over > HEARD) & (loud > HEARD)
    count = np.maximum(use.sum(axis=0), 1)
    levels = decibels(np.maximum(over - 1.0, 0.1)), decibels(np.maximum(loud, 0.1))
    a, b = (use * (level - (use * level).sum(axis=0) / count) for level in levels)
    return float(np.sum(a * b) / np.sqrt(np.sum(a * a) * np.sum(b * b) + 1e-12))


def _coherent(said: NDArray[np.complex64], rest: NDArray[np.complex64], use: NDArray[np.bool_]) -> bool:
    """Whether one gain of the voice around each cell explains COHERENT of the residual's power: over PLACES, or shifted by one of SHIFTS."""
    if any(_explained(said, rest, use, place) >= COHERENT for place in PLACES):
        return True
    said, rest, use = said[::4], rest[::4], use[::4]
    sides = ((said[:, :-by], rest[:, by:]) for by in SHIFTS), ((said[:, by:], rest[:, :-by]) for by in SHIFTS)
    return any(_explained(*pair, use, SHIFTED) >= COHERENT for pair in chain(*sides))


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
    power = power_of(_spectra(left, LONG))[:, : LONG * 3 // 16]
    log = np.log(power + 1e-6)
    use = _whole(heard, LONG)[:, None] & (uniform_filter1d(power, AROUND, axis=1) > 2.0 * HEARD)
    fine = (log - uniform_filter1d(log, AROUND, axis=1)) * use
    return float(np.sqrt(np.sum(fine * fine) / max(np.count_nonzero(use), 1)))
