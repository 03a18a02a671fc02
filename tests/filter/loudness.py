"""Whether a filter makes anything louder than the microphone heard it."""

import numpy as np

from edgefilter.types import SAMPLE_RATE

INAUDIBLE = 1e-9
"""Mean square, -90 dB of full scale, added to both sides: of digital silence nothing can be a decibel louder."""


def loudest_over_mic_db(mic: np.ndarray, out: np.ndarray) -> float:
    """Largest level of out over mic, any second, steps of 50 ms."""
    before, after = (np.concatenate(([0.0], np.cumsum(np.square(x, dtype=np.float64)))) for x in (mic, out))
    at = np.arange(0, mic.size - SAMPLE_RATE, SAMPLE_RATE // 20)
    powers = [(total[at + SAMPLE_RATE] - total[at]) / SAMPLE_RATE + INAUDIBLE for total in (before, after)]
    return float((10 * np.log10(powers[1] / powers[0])).max())
