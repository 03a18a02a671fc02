"""The microphone's converter or amplifier runs out of range."""

from __future__ import annotations

import numpy as np

from edgefilter.echo.effect import NEVER_REACHED, Effect, Parameter, first, neutral
from edgefilter.echo.effects.gain_fit import EXCERPT, loudest
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Samples

HARD, HARDNESS = 100.0, (10.0, 5.0, 3.0, 2.0)
"""Hardness of the curve from which on it counts as hard clipping, and the softer ones that are tried."""
STEPS = 1.0 - np.array([0.0, 0.01, 0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5])
"""Levels that are tried, re the recording's largest sample."""


class MicClipping(Effect):
    """y = x / (1 + |x / level|^p)^(1/p): an amplifier that saturates at +-level (Rapp 1991, eq. 1), p its hardness.

    p = 2 is a soft limiter; from 100 on it is a hard clip. Level 100 (full scale is 1) stands for no limit.
    """

    name = "mic_clipping"
    stage = "microphone"
    family = "static nonlinearity"
    title = "microphone clipping"
    complexity = 1
    memory = 0
    parameters = (
        Parameter("level", "full scale", NEVER_REACHED, 1e-4, NEVER_REACHED),
        Parameter("hardness", "", HARD, 1.0, HARD),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        level, hardness = float(values["level"]), float(values["hardness"])
        if level >= NEVER_REACHED:
            return x.copy()
        if hardness >= HARD:
            return np.clip(x, -level, level)
        over = np.abs(x / np.float32(level)).astype(np.float64)
        return (x / (1.0 + over**hardness) ** (1.0 / hardness)).astype(np.float32)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The level and hardness that leave the least of the whitened recording, a gain free in each; neutral where none does."""
        part = loudest(measurement.recording, measurement.weights > 0.0, EXCERPT)
        chosen, recording = measurement.weights[part], measurement.whiten(measurement.recording[part])
        predicted = measurement.predicted(model)[0][part]
        top = float(np.max(np.abs(measurement.recording), initial=0.0))
        if top <= 1e-4:
            return neutral(self)

        def left(level: float, hardness: float) -> float:
            limited = self.apply(predicted, {"level": level, "hardness": hardness}, SAMPLE_RATE)
            white = measurement.whiten(limited) * chosen
            energy = float(np.dot(white, white))
            return total - float(np.dot(recording, white)) ** 2 / energy if energy > 0.0 else total

        total = float(np.dot(recording * chosen, recording * chosen))
        plain = left(NEVER_REACHED, HARD)
        least, level = min(((left(level, HARD), level) for level in top * STEPS), key=lambda tried: tried[0])
        found = (least, float(level), HARD)
        for hardness in HARDNESS:
            for factor in (0.85, 1.0, 1.15):
                level = min(found[1] * factor, 0.99 * NEVER_REACHED)
                found = min(found, (left(level, hardness), level, hardness))
        for factor in (0.97, 0.985, 1.015, 1.03):
            level = min(found[1] * factor, 0.99 * NEVER_REACHED)
            found = min(found, (left(level, found[2]), level, found[2]))
        variance = found[0] / max(chosen.sum(), 1.0)
        if plain - found[0] <= 2.0 * variance * np.log(max(chosen.sum(), 2.0)):
            return neutral(self)
        return {"level": found[1], "hardness": found[2]}

    def sentence(self, values: Values) -> str:
        return (
            f"the predicted peaks exceed {first(values, 'level'):.3f} of full scale, which the recorded peaks never do"
        )
