"""By how much a recording lags behind its prediction, block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.lag import climb
from edgefilter.echo.measurement import Measurement, VoiceModel
from edgefilter.types import Array, Samples

BLOCK, REACH = 4000, 2400
"""BLOCK: samples of which one lag is estimated, a quarter of a second. REACH: the longest lag of either sign, samples, 150 ms."""
LEAST_CORRELATION = 0.3
"""Blocks whose normalised correlation at the best lag is below this say nothing about the lag."""


@dataclass(frozen=True, eq=False)
class LagTrack:
    """The lag block by block. starts (b,): first sample of each block of `size` samples.

    lag, sigma (b,): samples, the recording behind the prediction. correlation (b,): with it at that lag, 0 to 1.
    """

    starts: NDArray[np.integer]
    size: int
    lag: Array
    sigma: Array
    correlation: Array

    @property
    def middle(self) -> Array:
        """The middle of each block, (b,) in samples."""
        return self.starts + self.size / 2


def lags_of(measurement: Measurement, model: VoiceModel) -> LagTrack:
    """The lags of a recording behind what a model predicts, in BLOCKs that may be fitted to; what several fits share."""
    return track_lag(measurement.predicted(model)[1], measurement.white_recording, measurement.fit, BLOCK, REACH)


def track_lag(predicted: Samples, recording: Samples, fit: NDArray[np.bool_] | None, size: int, reach: int) -> LagTrack:
    """Lags of up to +-reach samples of all blocks of `size` samples, every size / 2, that lie in fit and where the robot is heard.

    predicted, recording: (n,), both whitened. The peak of each block's cross-correlation, then Newton's method on the
    phase of its cross-spectrum: the maximum-likelihood lag in white noise (Knapp & Carter 1976). sigma: the Cramer-Rao
    bound, with distortion and reverberation as noise.
    """
    starts = np.arange(0, recording.size - size + 1, size // 2)
    if fit is not None and starts.size:
        allowed = np.concatenate(([0], np.cumsum(fit)))
        starts = starts[allowed[starts + size] - allowed[starts] == size]
    if not starts.size:
        return LagTrack(starts, size, np.zeros(0), np.zeros(0), np.zeros(0))
    padded = np.pad(predicted, (reach, reach))
    wide = padded[starts[:, None] + np.arange(size + 2 * reach)]
    block = recording[starts[:, None] + np.arange(size)]
    whole, correlation = _coarse(wide, block, reach)
    near = np.take_along_axis(wide, reach - whole[:, None] + np.arange(size), axis=1)
    fraction, sigma = _fine(near, block)
    good = (correlation > LEAST_CORRELATION) & (np.abs(fraction) < 1.0) & np.isfinite(sigma)
    return LagTrack(starts[good], size, (whole + fraction)[good], sigma[good], correlation[good])


def _coarse(wide: Samples, block: Samples, reach: int) -> tuple[NDArray[np.integer], Array]:
    """Whole lags (b,) and the normalised correlation there."""
    n = scipy.fft.next_fast_len(wide.shape[1], real=True)
    cross = scipy.fft.irfft(scipy.fft.rfft(wide, n) * np.conj(scipy.fft.rfft(block, n)), n)[:, : 2 * reach + 1]
    energy = np.cumsum(np.pad(wide.astype(np.float64) ** 2, ((0, 0), (1, 0))), axis=1)
    size = block.shape[1]
    energy = energy[:, size : size + 2 * reach + 1] - energy[:, : 2 * reach + 1]
    own = np.sum(block.astype(np.float64) ** 2, axis=1, keepdims=True)
    normal = cross / np.sqrt(np.maximum(energy, 1e-3 * energy.max(axis=1, keepdims=True)) * own + 1e-30)
    peak = np.argmax(normal, axis=1)
    return reach - peak, np.take_along_axis(normal, peak[:, None], axis=1)[:, 0]


def _fine(near: Samples, block: Samples) -> tuple[Array, Array]:
    """Lag between samples that is left after the whole lag was taken out, and its standard deviation: (b,) each, samples."""
    window = np.hanning(block.shape[1]).astype(np.float32)
    a, b = scipy.fft.rfft(near * window), scipy.fft.rfft(block * window)
    cross = b * np.conj(a)
    w = (2 * np.pi / block.shape[1] * np.arange(a.shape[1])).astype(
        np.float32
    )  # w in single precision, as the spectra are
    lag = np.array([climb(row, w, 0.0, steps=6) for row in cross])
    turned = cross * np.exp(1j * w * lag[:, None])
    power = np.abs(a) ** 2
    gain = (turned.real.sum(axis=1) / np.maximum(power.sum(axis=1), 1e-30))[:, None]
    left = np.mean(np.abs(b) ** 2 - gain**2 * power, axis=1)
    return lag, np.sqrt(np.maximum(left, 0) / np.maximum(2 * gain[:, 0] ** 2 * (power @ w**2), 1e-30)) + 1e-3
