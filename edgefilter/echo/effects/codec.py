"""A codec on the way to the loudspeaker: noise that follows the voice, which the reference does not hold."""

from __future__ import annotations

from itertools import product

import numpy as np
import scipy

from edgefilter.dsp.frames import decibels
from edgefilter.echo.effect import Effect, Parameter, first, neutral, numbers, within
from edgefilter.echo.effects.codec_signs import HEARD, is_codec
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
    shown_by = ("levels", "tone")
    complexity = 3
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
        if not is_codec(measurement, predicted):
            return neutral(self)
        over, voice = band_power(target - predicted), band_power(predicted)
        use = frames_to_fit(measurement.fit, len(over))
        loud = use & (voice.mean(axis=1) > HEARD)
        clear = voice[loud].mean(axis=0) > CLEAR if loud.any() else np.zeros(BANDS, bool)
        if not clear.any() or np.median(over[loud].mean(axis=0)[clear]) < STANDS_OUT:
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
    delayed = np.concatenate((np.zeros(PRE_ROLL, np.float32), x))[: x.size]
    return np.maximum(scipy.signal.lfilter([1.0 - keep], [1.0, -keep], band_power(delayed), axis=0), 1e-12)
