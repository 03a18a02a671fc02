"""A gain that changes without a click."""

from __future__ import annotations

import numpy as np

from edgefilter.types import Samples

FADE_S = 0.01
"""From silence to full gain, or back: no click, and over before a syllable is."""


class Fade:
    """Applies a gain to sound that comes in blocks; set `wanted`, and the next samples go there, by one in FADE_S at most.

    >>> fade = Fade()
    >>> fade.wanted = 0.5
    >>> fade.apply(np.ones(4, np.float32), 400).tolist()  # the rate is so low that a sample changes the gain by a quarter
    [0.75, 0.5, 0.5, 0.5]
    """

    def __init__(self) -> None:
        self.wanted = self._gain = 1.0

    def apply(self, samples: Samples, rate: int) -> Samples:
        """Return samples (n,) or (n, channels) with the gain, the very same where it is 1; rate: theirs, Hz."""
        if self._gain == self.wanted == 1.0 or not len(samples):
            return samples
        reach = np.arange(1, len(samples) + 1) / (FADE_S * rate)
        gains = self._gain + np.clip(self.wanted - self._gain, -reach, reach)
        self._gain = float(gains[-1])
        return samples * gains.astype(np.float32).reshape(-1, *[1] * (samples.ndim - 1))
