"""A recording of the robot alone as a fit gets it, and the whitening in which it is compared."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from edgefilter.dsp.convolution import convolve, filtered
from edgefilter.dsp.psd import floored
from edgefilter.types import SAMPLE_RATE, Array, Samples

Values: TypeAlias = Mapping[str, "float | Array"]
"""The parameters of one effect by name."""
Result = TypeVar("Result")
SILENT = 0.1
"""Part of the fan's power under which a predicted voice leaves the fan alone: the two are 0.4 dB louder than the fan."""
ORDINARY_DB = 0.4
"""By which a gain differs at most from day to day, or moves while it stands still."""
STEADY_DB = 1.5
"""By which a fan's level differs at most from what is expected of it, and from one tenth of a second to another, whitened by
its own spectrum (the loud and the quiet tenth of three real ones by 0.9 to 1.0, of a running tap by 1.2; of a talker, or of
something that slams, by more)."""
REMEMBERED = 6
"""Number of models whose predictions a measurement keeps: the one from which a search goes on, and some that it compares with it."""


class VoiceModel(Protocol):
    """What an effect's fit may ask of the model that it is added to; EchoModel is one."""

    @property
    def impulse_response(self) -> Samples:
        """The linear path, starting PRE_ROLL samples before the direct sound, (taps,)."""

    @property
    def timed(self) -> bool:
        """Whether what the model predicts depends on when the recording began."""

    @property
    def as_filter(self) -> tuple[Samples, int] | None:
        """The filter (taps,) that does what `predict` does, and the samples by which it leads; None where that is not linear or changes with time."""

    def predict(self, reference: Samples) -> Samples:
        """The robot's voice at the microphone (n,) for an aligned reference (n,)."""

    def unpredictable(self, reference: Samples) -> Sequence[tuple[Samples, Array]]:
        """Of each source of the noise that effects add: its expected square (n,), and its density (601,) per Hz."""

    def response(self) -> Samples:
        """The linear path with the effects that change it, (taps,)."""

    def over(self, response: Samples) -> VoiceModel:
        """The model with this response (taps,) in place of its own."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """The robot alone: reference (n,), aligned up to what an effect may do to time, and the recording (n,) of it, float32, 16 kHz.

    noise_psd: (601,) one-sided power spectral density of the fan, full scale^2/Hz, from 0 to 8 kHz; None where it is
    unknown.
    fit: (n,) bool, the samples that a fit may use; the others are held out to test it on. None: all.
    calibrated_psd: (601,) of the calibration's fan, where the profile has another one by now; None: the same.
    """

    reference: Samples
    recording: Samples
    noise_psd: Samples | None = None
    fit: NDArray[np.bool_] | None = None
    calibrated_psd: Samples | None = None
    _done: dict[VoiceModel, dict[object, Any]] = field(default_factory=dict, init=False, repr=False)

    @property
    def weights(self) -> Samples:
        """Weights, 1 where a fit may use the sample, else 0, (n,) float32."""
        return np.ones(self.recording.size, np.float32) if self.fit is None else self.fit.astype(np.float32)

    def whiten(self, x: Samples) -> Samples:
        """The signal x (n,) through a zero-phase filter after which the fan is white with variance 1; x itself where the fan is unknown."""
        return x if self._whitening is None else filtered(x, self._whitening, self._whitening.size // 2)

    def heard(self, model: VoiceModel, x: Samples) -> Samples:
        """What a model predicts for another reference x (m,), whitened, (m,); by one filter where the model is a filter."""
        whole = self.once(_whitened, model)
        return self.whiten(model.predict(x)) if whole is None else filtered(x, *whole)

    @cached_property
    def fingerprint(self) -> float:
        """A whole number of 52 bits that tells this recording from others, from its samples at 16 bit."""
        digest = hashlib.sha256(np.round(self.recording * 32768.0).astype(np.int32).tobytes()).digest()
        return float(int.from_bytes(digest[:8], "big") >> 12)

    @cached_property
    def _whitening(self) -> Samples | None:
        return None if self.noise_psd is None else whitening_taps(self.noise_psd)

    @cached_property
    def white_recording(self) -> Samples:
        """The recording, whitened, (n,)."""
        return self.whiten(self.recording)

    def predicted(self, model: VoiceModel) -> tuple[Samples, Samples]:
        """What a model predicts for the reference, and that whitened, (n,) each; remembered, not to be written to."""
        return self.once(_predicted, model)

    def once(self, work: Callable[[Measurement, VoiceModel], Result], model: VoiceModel) -> Result:
        """What work makes of this measurement and a model, remembered of the latest models: what several fits share."""
        done = self._done[model] = self._done.pop(model, {})
        while len(self._done) > REMEMBERED:
            del self._done[next(iter(self._done))]
        if work not in done:
            done[work] = work(self, model)
        return done[work]

    def error(self, predicted: Samples) -> float:
        """Weighted sum of squares of the whitened recording minus predicted (n,): what a fit makes small."""
        residual = self.whiten(self.recording - predicted)
        return float(np.dot(residual * residual, self.weights))


def whiten(x: Samples, noise_psd: Samples) -> Samples:
    """Filter x (n,) by 1 / sqrt(noise_psd), floored, zero-phase, so that noise of that one-sided PSD gets variance 1."""
    taps = whitening_taps(noise_psd)
    return filtered(x, taps, taps.size // 2)


def whitening_taps(noise_psd: Samples) -> Samples:
    """The filter of `whiten`, its middle at the 600th, for a PSD (601,), (1199,)."""
    taps = np.fft.fftshift(np.fft.irfft(1.0 / np.sqrt(floored(noise_psd) * SAMPLE_RATE / 2)))[1:]
    taps *= np.hanning(taps.size + 2)[1:-1] ** 0.25
    return taps.astype(np.float32)


def _predicted(measurement: Measurement, model: VoiceModel) -> tuple[Samples, Samples]:
    predicted = model.predict(measurement.reference)
    return predicted, measurement.whiten(predicted)


def _whitened(measurement: Measurement, model: VoiceModel) -> tuple[Samples, int] | None:
    """One filter (taps,) for a model and the whitening of what it predicts, and the samples by which it leads; None where the model is no filter."""
    found, white = model.as_filter, measurement._whitening
    if found is None or white is None:
        return found
    return convolve(found[0], white), found[1] + white.size // 2


def level_ratio(recording: Samples, predicted: Samples) -> float:
    """Least-squares gain from predicted to recording, both (n,); 1 where nothing was predicted."""
    energy = float(np.dot(predicted, predicted))
    return float(np.dot(recording, predicted)) / energy if energy > 0.0 else 1.0
