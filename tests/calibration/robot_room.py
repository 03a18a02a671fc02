"""A room and a fan that are known: what tests of the calibration share."""

import numpy as np
from scipy import signal

FAN_RMS = 1e-3


def room(rt60=0.25, seed=5, taps=8000):
    """A path with its direct sound at 0: unit direct sound, decaying reflections from 3 ms on, band-limited."""
    rng = np.random.default_rng(seed)
    t = np.arange(taps) / 16000
    path = 0.15 * rng.standard_normal(taps) * 10 ** (-3 * t / rt60)
    path[:48] = 0
    path[0] = 1.0
    return 0.15 * path


def fan(count, seed=1, rms=FAN_RMS):
    noise = signal.lfilter([1.0], [1.0, -0.8], np.random.default_rng(seed).standard_normal(count))
    return rms * noise / noise.std()
