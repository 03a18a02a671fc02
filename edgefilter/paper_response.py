"""The paper's two readings of |H_m(f) H_s(f)|: from the spectrogram of a sweep, and from a sine that rises in steps of 13 Hz."""

from __future__ import annotations

import numpy as np
from scipy import signal

from edgefilter.errors import CalibrationError
from edgefilter.types import SAMPLE_RATE, Array, Samples

STEP_HZ = 13
STEP_SAMPLES = 1600
"""0.1 s a step, inferred (the paper does not say): one frame of 1200 samples after 400 for the room to settle."""
FRAME, HOP = 1200, 160
_WINDOW = signal.get_window("hann", FRAME)


def generate_stepped_sine(level: float = 0.35, lead_s: float = 0.5, tail_s: float = 1.0) -> Samples:
    """The paper's calibration signal (n,) float32: a sine of 0 to 8001 Hz in steps of 13 Hz, 0.1 s each, phase-continuous.

    616 steps, the last at 7995 Hz, 63 s with the silence around it.

    >>> generate_stepped_sine().shape
    (1009600,)
    """
    steps = np.repeat(_step_frequencies(), STEP_SAMPLES)
    tone = level * np.sin(2 * np.pi * np.cumsum(steps) / SAMPLE_RATE)
    return np.pad(tone, (round(lead_s * SAMPLE_RATE), round(tail_s * SAMPLE_RATE))).astype(np.float32)


def _step_frequencies() -> Array:
    return np.arange(0, 8001, STEP_HZ, dtype=np.float64)


def response_from_stepped_sine(recording: Samples, noise: Samples, frequencies: Array, level: float = 0.35, lead_s: float = 0.5) -> Samples:
    """|H_m(f) H_s(f)| (len(frequencies),) float32 from a recording (n,) of generate_stepped_sine(level, lead_s).

    Eq. (3)-(5) of the paper step by step: (|X_m(f)| - |N(f)|) / |A(f)| with one Hann frame of 1200 samples at the end of each step,
    |N(f)| the mean magnitude of the fan in such a frame, negative differences set to 0. The lag of the recording is found by
    cross-correlation. Between the steps (13 Hz) the response is interpolated; the 0 Hz step is silent, so below 13 Hz it is 0.
    Raises CalibrationError where recording does not contain the stepped sine or ends before it.
    """
    reference = generate_stepped_sine(level, lead_s).astype(np.float64)
    correlation = signal.correlate(recording, reference, "full", "fft")
    lags = np.arange(correlation.size) - (reference.size - 1)
    near = (lags >= -2000) & (lags <= 2 * SAMPLE_RATE)
    peak = np.abs(correlation[near])
    if not peak.max(initial=0.0) > 12 * np.sqrt(np.mean(peak**2)):
        raise CalibrationError("the stepped-sine recording does not contain the stepped sine: is it the right file?")
    lag = int(lags[near][np.argmax(peak)])
    steps = _step_frequencies()
    ends = round(lead_s * SAMPLE_RATE) + STEP_SAMPLES * np.arange(1, steps.size + 1)
    if recording.size < ends[-1] + lag:
        last = steps[np.searchsorted(ends + lag, recording.size)]
        raise CalibrationError(f"the stepped-sine recording ends at {last:.0f} Hz, expected {steps[-1]:.0f} Hz: record it to its end")
    frames = ends[:, None] + np.arange(-FRAME, 0)
    played = _tone_magnitude(reference[frames], steps)
    heard = _tone_magnitude(recording[np.maximum(frames + lag, 0)], steps)
    fan = np.interp(steps, np.arange(FRAME // 2 + 1) * SAMPLE_RATE / FRAME, mean_magnitude(noise))
    response = np.maximum(heard - fan, 0.0) / np.maximum(played, 1e-9)
    response[0] = 0.0
    return np.interp(frequencies, steps, response, right=response[-1]).astype(np.float32)


def _tone_magnitude(frames: Array, frequencies: Array) -> Array:
    """|DFT| of each Hann-weighted frame (k, FRAME) at its own frequency (k,)."""
    turn = np.exp(-2j * np.pi * frequencies[:, None] / SAMPLE_RATE * np.arange(FRAME))
    return np.abs(np.sum(frames * _WINDOW * turn, axis=1))


def mean_magnitude(samples: Samples) -> Array:
    """Mean |spectrum| (601,) over Hann frames of 1200 samples, hop 160."""
    return np.abs(_frames(samples)).mean(axis=0)


def response_from_sweep(reference: Samples, recording: Samples, noise: Samples, delay: int) -> Samples:
    """The paper's |H_m(f) H_s(f)| (601,) float32, eq. (3)-(5), from any sweep: sum_t (|X_m(t,f)| - |N(f)|) / sum_t |A(t,f)|.

    Hann frames of 1200 samples, hop 160; for each bin, those frames t in which the reference, delayed by delay samples, is within
    20 dB of its maximum in that bin. Negative sums are set to 0, and so are bins in which the sweep has no energy
    (60 dB below its strongest bin). Reverberation that outlasts the frame is not part of this reading.
    """
    played = np.abs(_frames(np.pad(reference, (max(delay, 0), 0))[max(-delay, 0) :]))
    heard = np.abs(_frames(recording))
    count = min(len(played), len(heard))
    played, heard = played[:count], heard[:count]
    strongest = played.max(axis=0)
    use = played > 0.1 * strongest
    excess = np.sum(use * (heard - mean_magnitude(noise)), axis=0)
    response = np.maximum(excess, 0.0) / np.maximum(np.sum(use * played, axis=0), 1e-9)
    return np.where(strongest > 1e-3 * strongest.max(), response, 0.0).astype(np.float32)


def _frames(samples: Samples) -> Array:
    """(frames, 601) complex spectra."""
    padded = np.pad(samples, (0, max(0, FRAME - samples.size)))
    return np.fft.rfft(np.lib.stride_tricks.sliding_window_view(padded, FRAME)[::HOP] * _WINDOW, axis=1)
