"""How much of the robot and of its fan is left in the linear stage's error, as power spectra that a mask can use."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edgefilter.stft import StftConfig
from edgefilter.types import Samples, Spectrum

if TYPE_CHECKING:
    from edgefilter.profile import Profile

LEAKAGE_START = 0.02
LEAKAGE_MEMORY = 0.98
TAIL_DECAY = 0.6


def power(spectrum: Spectrum) -> Samples:
    """|spectrum|^2 of any shape, without the square root of abs."""
    return spectrum.real**2 + spectrum.imag**2


class Residual:
    """Tracks the fan and the residual echo of one stream; step() once per frame."""

    def __init__(self, stft: StftConfig, profile: Profile | None = None) -> None:
        self.stft = stft
        self._fan = profile.noise_bins(stft) if profile is not None else None
        self.reset()

    def reset(self) -> None:
        """As before the first frame."""
        bins = self.stft.bins
        self._noise = np.full(bins, 1e-9, np.float32) if self._fan is None else self._fan.copy()
        self._echo = np.zeros(bins, np.float32)
        self._cross = np.full(bins, LEAKAGE_START, np.float32)
        self._auto = np.ones(bins, np.float32)

    def step(self, mic: Spectrum, reference: Spectrum, echo: Spectrum, error: Spectrum) -> tuple[Samples, Samples]:
        """Expected |fan|^2 and |residual echo|^2 in error, both (bins,) float32."""
        loud = power(echo)
        self._echo = np.maximum(loud, TAIL_DECAY * self._echo)
        return self._noise, (LEAKAGE_START * self._echo).astype(np.float32)
