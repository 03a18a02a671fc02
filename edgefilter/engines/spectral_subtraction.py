"""'ss': a gentle Wiener mask on the linear stage's error, from the expected powers of noise and residual echo."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.engines.linear import Linear
from edgefilter.types import Frame, Output, Samples

FLOOR = 0.18
"""Least gain, -15 dB: it keeps the noise natural and loses no words."""
MEMORY = 0.8
"""Decision-directed smoothing of the a-priori signal-to-noise ratio; the usual 0.98 smears onsets and costs words."""


class SpectralSubtraction(Linear):
    """Wiener gain xi / (1 + xi) with the decision-directed a-priori signal-to-noise ratio xi of Ephraim & Malah (1984).

    Eq. (51) there; xi: the human's power over that of noise and residual echo. State: power of the previous answer (bins,).
    """

    name: ClassVar[str] = "ss"

    def initial_state(self) -> Samples:
        return np.zeros(self.stft.bins, np.float32)

    def step(self, frame: Frame, state: Samples) -> tuple[Output, Samples]:
        unwanted = frame.noise_psd + frame.residual_psd + fourier.TINY
        observed = fourier.power(frame.error)
        wanted = MEMORY * state + (1.0 - MEMORY) * np.maximum(observed - unwanted, 0.0)
        gain = np.maximum(wanted / (wanted + unwanted), FLOOR)
        return Output(gain * frame.error), gain * gain * observed
