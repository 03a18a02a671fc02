"""A loudspeaker driven hard: its coil, its suspension and its amplifier bend, which adds harmonics and intermodulation."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from edgefilter.dsp.membrane import MOTION_TAPS
from edgefilter.echo.effect import Effect, Experiment, Family, Parameter, Stage, first, neutral
from edgefilter.echo.effects.gain_fit import loudest
from edgefilter.echo.effects.loudspeaker_fit import REACH_HZ, Laws, fit_laws
from edgefilter.echo.effects.loudspeaker_laws import amplifier_terms, driver_terms
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

BOUND = 4.0
"""Of each weight: at the end of its excursion a law is off by no more than this, whatever is played."""
SILENT_DB = -120.0
ORDINARY_DB = 0.4
"""A gain of less differs from day to day."""
MOST_GAIN_DB = 60.0
EXCERPT = 10 * SAMPLE_RATE
"""On the loudest stretch of that many samples, or the first where the model knows what time it is, it is chosen where the
laws bend; how much they do, on all."""
DRIVER, AMPLIFIER = ("force_factor", "stiffness", "damping"), ("even", "odd")


class SpeakerNonlinearity(Effect):
    """y = g (x + what a moving coil and an amplifier add whose laws bend), ahead of the linear path.

    force_factor, stiffness, damping: (2,) a, b of the relative change a s + b s^2 of each with the displacement, s
    within -1 and 1 (driver_terms); what they add drives the linear membrane like x itself, and the path behind holds
    that membrane. even, odd: (2,) weights of s x, s^3 x and of s^2 x, s^4 x with s the bent drive (amplifier_terms).
    resonance_hz: of the membrane. excursion, knee: displacement and drive, full scale, at which s has reached 0.7.
    gain_db: 20 log10 g, of an amplifier that is overdriven; the volume before it is `playback_gain`'s. What is added never
    grows faster than x. Valid while it is well below x.
    """

    name: ClassVar[str] = "speaker_nonlinearity"
    stage: ClassVar[Stage] = "source"
    family: ClassVar[Family] = "static nonlinearity"
    title: ClassVar[str] = "loudspeaker nonlinearity"
    cost: ClassVar[int] = 4
    shown_by: ClassVar[tuple[Experiment, ...]] = ("levels", "tone")
    flexible: ClassVar[bool] = True
    memory: ClassVar[int | None] = MOTION_TAPS
    parameters: ClassVar[tuple[Parameter, ...]] = (
        *(Parameter(name, "1", 0.0, -BOUND, BOUND) for name in (*DRIVER, *AMPLIFIER)),
        Parameter("resonance_hz", "Hz", 250.0, *REACH_HZ),
        Parameter("excursion", "full scale", 1.0, 1e-4, 100.0),
        Parameter("knee", "full scale", 1.0, 1e-4, 100.0),
        Parameter("level_db", "dB re the linear voice at the microphone", SILENT_DB, SILENT_DB, 20.0),
        Parameter("gain_db", "dB", 0.0, 0.0, MOST_GAIN_DB),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Return x (n,) with its distortion; level_db only reports."""
        out = x.copy()
        driving, bending = np.concatenate([_pair(values, name) for name in DRIVER]), _amplifier(values)
        if driving.any():
            out += driving @ driver_terms(x, first(values, "resonance_hz"), first(values, "excursion"), sample_rate)
        if bending.any():
            out += bending @ amplifier_terms(x, first(values, "knee"))
        gain_db = first(values, "gain_db")
        return out * np.float32(10.0 ** (gain_db / 20.0)) if gain_db else out

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Least squares in the whitened domain; neutral where no law holds on samples that it was not fitted to."""
        linear, x = measurement.heard(model)[1], measurement.reference
        part = slice(0, EXCERPT) if model.timed else loudest(x, EXCERPT)
        found = fit_laws(
            x,
            measurement.white_recording,
            measurement.weights,
            linear,
            lambda sound: measurement.whiten(model.predict(sound)),
            excerpt=part if x.size >= 1.5 * EXCERPT else None,
        )
        if found is None:
            return neutral(self)
        louder = found.gain_db >= ORDINARY_DB  # a voice that is softer was turned down, whatever else happened to it
        return {**as_values(found), "gain_db": min(found.gain_db, MOST_GAIN_DB) if louder else 0.0}

    def sentence(self, values: Values) -> str:
        """How strong the distortion is."""
        level_db = first(values, "level_db")
        return (
            f"products of the reference with itself, {level_db:.0f} dB re the voice, are in the residual: no linear"
            " path makes them"
        )


def as_values(laws: Laws) -> dict[str, float | Array]:
    """Laws as the effect's values."""
    driving = np.clip(laws.driver, -BOUND, BOUND).reshape(len(DRIVER), 2)
    bending = np.clip(laws.amplifier, -BOUND, BOUND)
    return {
        **dict(zip(DRIVER, driving, strict=True)),
        "even": bending[::2],
        "odd": bending[1::2],
        "resonance_hz": laws.resonance_hz,
        "excursion": float(np.clip(laws.excursion, 1e-4, 100.0)),
        "knee": float(np.clip(laws.knee, 1e-4, 100.0)),
        "level_db": float(np.clip(laws.level_db, SILENT_DB, 20.0)),
    }


def _pair(values: Values, name: str) -> Array:
    """Two numbers, zero behind a single one, (2,) float32."""
    pair, given = np.zeros(2, np.float32), np.ravel(values[name])[:2]
    pair[: given.size] = given
    return pair


def _amplifier(values: Values) -> Array:
    """Weights in the order of amplifier_terms, (4,) float32: even and odd in turn."""
    return np.stack([_pair(values, name) for name in AMPLIFIER], axis=1).ravel()
