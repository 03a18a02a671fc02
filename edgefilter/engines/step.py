"""One frame through an engine, whichever it is."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.engines.base import Engine, EngineState
from edgefilter.engines.spectral_subtraction import FLOOR
from edgefilter.types import Frame, Output, Spectrum


def step(engine: Engine, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
    """The engine's answer and its next state.

    Where the robot may arrive at any lag nothing tells it from a human: the answer is noise, nobody speaks, and the engine
    forgets the frame.
    """
    output, following = engine.step(frame, state)
    if not frame.at_any_lag:
        return output, following
    return Output(_noise_alone(frame), None if output.speech_probability is None else 0.0), state


def _noise_alone(frame: Frame) -> Spectrum:
    """Of the error no more than FLOOR of the noise, (bins,)."""
    power = fourier.power(frame.error)
    return FLOOR * np.sqrt(np.minimum(frame.noise_psd, power) / (power + fourier.TINY)) * frame.error
