"""A codec on the way to the loudspeaker: noise that follows the voice, which the reference does not hold."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import scipy

from edgefilter.dsp.frames import decibels
from edgefilter.echo.effect import Effect, Experiment, Family, Parameter, Stage, first, neutral
from edgefilter.echo.effects.codec_signs import signs_of
from edgefilter.echo.effects.knock_power import (
    BAND_HZ,
    BANDS,
    FRAME,
    HOP,
    band_power,
    colour_of_knocks,
    density_of,
    fan_in_bands,
)
from edgefilter.echo.evidence import Evidence
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

EMPHASIS_TAPS = 33
"""Of the filter through which the reference is as loud, band by band, as the noise."""
DECAYS_MS, EXPONENTS = (4.0, 8.0, 16.0, 32.0), (0.5, 0.7, 1.0)
"""Tried, by likelihood: a codec's frames and the room; and how the noise grows with the voice."""
NONE_DB = -100.0
VOICED = 2.0
"""Times the fan that the voice must be, where its noise is measured."""


class Codec(Effect):
    """Expected square of the noise at the microphone: sum(power) (d * (g * x)^2)^exponent, d a decay of unit sum.

    A codec spends its bits where the ear would hear the noise, so that this follows the voice in each band (Brandenburg
    & Bosi 1997, "Overview of MPEG audio: current and future standards for low-bit-rate audio coding"), yet has none of
    its phase: no waveform predicts it. emphasis_db (16,), in bands of 500 Hz, is the magnitude of g, by which the
    reference x is as loud in each as the noise; decay_ms and exponent: how it follows in time and level. power (16,)
    for that at 1. below_voice_db, noise re voice at the microphone, only reports. What the codec takes away of the band is a
    `bandlimit` beside it.
    """

    name: ClassVar[str] = "codec"
    stage: ClassVar[Stage] = "source"
    family: ClassVar[Family] = "additive noise"
    run_note: ClassVar[str] = (
        "the running filter follows by itself what noise the voice brings along: adding it changes nothing there"
    )
    title: ClassVar[str] = "a codec"
    shown_by: ClassVar[tuple[Experiment, ...]] = ("levels", "tone")
    complexity: ClassVar[int] = 3
    cost: ClassVar[int] = 4
    followed: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("power", "full scale^2", 0.0, 0.0, 1e3),
        Parameter("emphasis_db", "dB", 0.0, NONE_DB, 0.0),
        Parameter("decay_ms", "ms", 8.0, 0.1, 100.0),
        Parameter("exponent", "1", 1.0, 0.1, 2.0),
        Parameter("below_voice_db", "dB", 0.0, -60.0, 200.0),
    )

    def variance(self, reference: Samples, values: Values, sample_rate: int) -> Samples:
        """What the noise adds to the expected square of each sample (n,) at the microphone, for an aligned reference (n,)."""
        envelope = _envelope(_emphasised(reference, values["emphasis_db"]), float(values["decay_ms"]), sample_rate)
        return (float(np.sum(values["power"])) * envelope ** float(values["exponent"])).astype(np.float32)

    def colour(self, values: Values) -> Array:
        """The spectral density of that, (601,), 0 to 8 kHz, per Hz: its integral is 1."""
        return density_of(values["power"])

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Maximum likelihood of the residual's power in cells, as for a rattle's, for each decay and exponent.

        Neutral where the fan is unknown or nothing is left over it.
        """
        if measurement.noise_psd is None:
            return neutral(self)
        predicted, target = measurement.heard(model)[1], measurement.white_recording
        left = target - predicted
        use = np.ones(target.size, bool) if measurement.fit is None else measurement.fit
        over, voice, drive = band_power(left), band_power(predicted), band_power(measurement.reference)
        loud = use[np.arange(len(over)) * HOP + FRAME // 2] & (voice.mean(axis=1) > VOICED)
        if not loud.any():
            return neutral(self)
        noise = np.maximum(over[loud].mean(axis=0) - 1.0, 1e-3) * fan_in_bands(measurement.noise_psd)
        ratio_db = decibels(noise / np.maximum(drive[loud].mean(axis=0), 1e-12))
        emphasis_db = np.clip(ratio_db - ratio_db.max(), NONE_DB, 0.0)
        emphasised = _emphasised(measurement.reference, emphasis_db)
        best: tuple[float, float, float, Array] = (-np.inf, 8.0, 1.0, np.zeros(BANDS))
        for decay in DECAYS_MS:
            envelope = _envelope(emphasised, decay)
            for exponent in EXPONENTS:
                likelihood, power = colour_of_knocks(left, envelope**exponent, measurement.fit)
                best = max(best, (likelihood, decay, exponent, power), key=lambda entry: entry[0])
        _, decay, exponent, power = best
        below = decibels(float(np.mean(voice[loud]))) - decibels(
            float(np.mean(np.maximum(over[loud] - 1.0, 0.0))) + 1e-9
        )
        return {
            "power": np.clip(power * fan_in_bands(measurement.noise_psd), 0.0, 1e3),
            "emphasis_db": emphasis_db,
            "decay_ms": decay,
            "exponent": exponent,
            "below_voice_db": float(np.clip(below, -60.0, 200.0)),
        }

    def sentence(self, values: Values) -> str:
        """How loud the noise is, and what it is not."""
        return (
            f"noise {first(values, 'below_voice_db'):.0f} dB below the voice follows it in every band, but neither its phase nor"
            " its harmonics: what a codec leaves, and no waveform predicts; it is shown as irreducible"
        )

    def plausible(self, evidence: Evidence) -> bool:
        """What is left follows the voice's level in each band, but not its phase, nor its harmonics."""
        return signs_of(evidence).of_a_codec


def _emphasised(x: Samples, emphasis_db: float | Array) -> Samples:
    """Put x (n,) through a filter of that magnitude in bands of 500 Hz, delayed by half its taps."""
    gain_db = np.broadcast_to(np.asarray(emphasis_db, float), (BANDS,))
    centres = (np.arange(BANDS) + 0.5) * BAND_HZ
    taps = scipy.signal.firwin2(
        EMPHASIS_TAPS,
        np.concatenate(([0.0], centres, [SAMPLE_RATE / 2])),
        10.0 ** (np.concatenate((gain_db[:1], gain_db, gain_db[-1:])) / 20.0),
        fs=SAMPLE_RATE,
    )
    return scipy.signal.lfilter(taps, [1.0], x).astype(np.float32)


def _envelope(x: Samples, decay_ms: float, sample_rate: int = SAMPLE_RATE) -> Samples:
    """Mean square of x (n,), (n,), decaying by 1/e in decay_ms, as late as the direct sound."""
    keep = np.exp(-1.0 / (decay_ms * 1e-3 * sample_rate))
    late = PRE_ROLL - EMPHASIS_TAPS // 2
    delayed = np.concatenate((np.zeros(late), x.astype(np.float64) ** 2))[: x.size]
    return np.maximum(scipy.signal.lfilter([1.0 - keep], [1.0, -keep], delayed), 0.0).astype(np.float32)
