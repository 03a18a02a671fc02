"""The bands that recognisers and speaker encoders hear in."""

from __future__ import annotations

import numpy as np

from edgefilter.types import SAMPLE_RATE


def mel_filters(count: int, n_fft: int) -> np.ndarray:
    """Triangles of equal area on the scale of Slaney's Auditory Toolbox (1998), (count, n_fft / 2 + 1) float32.

    That scale is linear below 1 kHz, 15 a kHz, and logarithmic above, 27 to a factor of 6.4.
    """
    linear_mels, per_factor = 15.0, 27.0 / np.log(6.4)
    top = linear_mels + per_factor * np.log(SAMPLE_RATE / 2 / 1000)
    mels = np.linspace(0, top, count + 2)
    edges = np.where(mels < linear_mels, mels / linear_mels, np.exp((mels - linear_mels) / per_factor)) * 1000
    bins = np.fft.rfftfreq(n_fft, 1 / SAMPLE_RATE)
    rise = (bins - edges[:-2, None]) / np.diff(edges)[:-1, None]
    fall = (edges[2:, None] - bins) / np.diff(edges)[1:, None]
    area = 2.0 / (edges[2:] - edges[:-2])[:, None]
    return (area * np.maximum(0.0, np.minimum(rise, fall))).astype(np.float32)
