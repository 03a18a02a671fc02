"""A whole clip to frames and back, for what answers only at its end."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.stft import Analyser, StftConfig, Synthesiser
from edgefilter.types import Array, Samples


def analysed(config: StftConfig, samples: Samples) -> Array:
    """Frames (m, bins) of samples (n,), as many as bring every sample out again."""
    analysis = Analyser(config)
    hops = -(-samples.size // config.hop) + config.window_length // config.hop - 1
    fed = np.pad(samples, (0, hops * config.hop - samples.size))
    return np.array([analysis.push(hop)[0] for hop in fed.reshape(hops, config.hop)])


def synthesised(config: StftConfig, frames: Array, size: int) -> Samples:
    """Samples (size,) of frames (m, bins), aligned with those that analysed() got."""
    voice = Synthesiser(config)
    hops = [voice.push(frame) for frame in frames.astype(np.complex64)]
    return np.concatenate(hops)[config.window_length - config.hop :][:size]
