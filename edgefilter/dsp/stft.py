"""The short-time Fourier transform as a stream sees it: one hop in, one frame; one frame in, one hop out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.dsp.psd import hann
from edgefilter.errors import StftError
from edgefilter.types import SAMPLE_RATE, Array, Samples, Spectrum


@dataclass(frozen=True)
class StftConfig:
    """Window, hop and FFT size; refuses a combination that no synthesis window can invert.

    window_length samples are weighted by the analysis window ("root-hann": square root of a periodic Hann; "hann";
    "rectangular") and zero-padded to n_fft. Synthesis uses the canonical dual window g = w / sum_k w^2(n + k hop)
    (Griffin & Lim 1984, eq. 6), so that analysis followed by synthesis is the identity.
    Raises StftError for sizes that do not fit together, or where that sum vanishes.
    """

    n_fft: int = 512
    hop: int = 256
    window_length: int = 512
    window: str = "root-hann"

    def __post_init__(self) -> None:
        if min(self.n_fft, self.hop, self.window_length) < 1 or self.window_length > self.n_fft:
            raise StftError(
                f"STFT sizes are n_fft={self.n_fft}, hop={self.hop}, window_length={self.window_length}; "
                "expected hop >= 1 and 1 <= window_length <= n_fft"
            )
        if self.window not in ("root-hann", "hann", "rectangular"):
            raise StftError(f"STFT window is '{self.window}', expected root-hann, hann or rectangular")
        coverage = self._coverage
        if coverage.min() < 1e-3 * coverage.max():
            raise StftError(
                f"STFT cannot be inverted: with a {self.window} window of {self.window_length} and hop {self.hop} some"
                f" samples get {coverage.min():.1e} of weight; use a hop of at most {self.window_length // 2}"
            )

    @property
    def bins(self) -> int:
        """Number of frequencies from 0 to the Nyquist frequency."""
        return self.n_fft // 2 + 1

    @cached_property
    def frequencies(self) -> Array:
        """Frequencies of the bins, (bins,) in Hz."""
        return np.arange(self.bins) * SAMPLE_RATE / self.n_fft

    @cached_property
    def analysis_window(self) -> Samples:
        """The analysis window, (window_length,) float32."""
        return self._window64.astype(np.float32)

    @cached_property
    def synthesis_window(self) -> Samples:
        """The synthesis window, canonical dual of the analysis window, (window_length,) float32."""
        return (self._window64 / self._coverage).astype(np.float32)

    @cached_property
    def _window64(self) -> Array:
        if self.window == "rectangular":
            return np.ones(self.window_length)
        window = hann(self.window_length)
        return np.sqrt(window) if self.window == "root-hann" else window

    def waiting_window(self, wait: int) -> Samples:
        """Analysis window for a frame whose last `wait` samples are not there yet, (window_length,) float32: zero there.

        The other frames that touch these samples weigh them so that synthesis still gives the identity.
        """
        window = self._window64.copy()
        window[window.size - wait :] = 0.0
        return (window / np.maximum(self._over_frames(window * self.synthesis_window), 1e-3)).astype(np.float32)

    @property
    def _coverage(self) -> Array:
        """Sum of the squared window over all frames that touch a sample, (window_length,)."""
        return self._over_frames(self._window64**2)

    def _over_frames(self, weight: Array) -> Array:
        """Sum of a frame's weights over all frames that touch a sample, (window_length,)."""
        padded = np.zeros(-(-self.window_length // self.hop) * self.hop)
        padded[: self.window_length] = weight
        return np.resize(padded.reshape(-1, self.hop).sum(axis=0), self.window_length)

    def noise_gain(self) -> float:
        """Expected |spectrum|^2 of white noise of unit variance: the sum of the squared window."""
        return float(np.sum(self._window64**2))


class Analyser:
    """Holds the last window_length samples of each channel; before the first sample there is silence."""

    def __init__(self, config: StftConfig, channels: int = 1) -> None:
        self.config = config
        self._recent = np.zeros((channels, config.window_length), np.float32)
        self._newest = list(self._recent[:, -config.hop :])
        self._padded = np.zeros((channels, config.n_fft), np.float32)
        self._windowed, self._window = self._padded[:, : config.window_length], config.analysis_window
        self._wait = 0

    def push(self, *hop_samples: Samples, wait: int = 0) -> Spectrum:
        """Take the next hop (hop,) of each channel; return the frame that ends with it, (channels, bins) complex64.

        wait: samples by which the channels are late: so many at the frame's end are missing, and zero.
        """
        if wait != self._wait:
            self._wait, self._window = wait, self.config.waiting_window(wait)
            self._windowed[:, self.config.window_length - wait :] = 0.0
        recent, hop = self._recent, self.config.hop
        recent[:, :-hop] = recent[:, hop:]
        for newest, samples in zip(self._newest, hop_samples, strict=True):
            newest[:] = samples
        there = self.config.window_length - wait
        np.multiply(recent[:, wait:], self._window[:there], out=self._windowed[:, :there])
        return fourier.rfft(self._padded)


class Synthesiser:
    """Overlap-add; each frame finishes one hop of samples, which lag window_length - hop behind the frame's end.

    sounds: how many there are at once; None for one, without an axis for them.
    """

    def __init__(self, config: StftConfig, sounds: int | None = None) -> None:
        self.config = config
        lead = (sounds,) if sounds else ()
        self._sum = np.zeros((*lead, config.window_length), np.float32)
        self._frame = np.zeros((*lead, config.n_fft), np.float32)
        self._weighted, self._window = self._frame[..., : config.window_length], config.synthesis_window

    def push(self, spectrum: Spectrum) -> Samples:
        """Add one frame (sounds, bins) complex64; return the (sounds, hop) samples that no later frame will change."""
        total, hop = self._sum, self.config.hop
        fourier.irfft(np.asarray(spectrum, np.complex64), self.config.n_fft, out=self._frame)
        self._weighted *= self._window
        total += self._weighted
        done = total[..., :hop].copy()
        total[..., :-hop] = total[..., hop:]
        total[..., -hop:] = 0.0
        return done
