"""What one physical effect has to offer, and the registry in which effects are found by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.psd import floored
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, Array, Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel

Values: TypeAlias = Mapping[str, "float | Array"]
Stage: TypeAlias = Literal["source", "path", "time", "microphone", "noise"]
STAGES: tuple[Stage, ...] = ("source", "path", "time", "microphone", "noise")
"""In the order in which sound meets them."""
REMEMBERED = 6
"""Models whose predictions a measurement keeps."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect, or an array of such numbers: unit, the value at which the effect vanishes, the values that are possible."""

    name: str
    unit: str
    neutral: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Measurement:
    """The robot alone: reference (n,), aligned up to what an effect may do to time, and the recording (n,) of it, float32, 16 kHz.

    noise_psd: (601,) one-sided power spectral density of the fan, full scale^2/Hz, from 0 to 8 kHz; None where it is unknown.
    fit: (n,) bool, the samples that a fit may use; the others are held out to judge it by. None: all.
    """

    reference: Samples
    recording: Samples
    noise_psd: Samples | None = None
    fit: NDArray[np.bool_] | None = None
    _heard: dict[EchoModel, tuple[Samples, Samples]] = field(default_factory=dict, init=False, repr=False)

    @property
    def weights(self) -> Samples:
        """(n,) float32, 1 where a fit may use the sample, else 0."""
        return np.ones(self.recording.size, np.float32) if self.fit is None else self.fit.astype(np.float32)

    def whiten(self, x: Samples) -> Samples:
        """x (n,) through a zero-phase filter after which the fan is white with variance 1; x itself where the fan is unknown."""
        return x if self.noise_psd is None else whiten(x, self.noise_psd)

    @cached_property
    def white_recording(self) -> Samples:
        """(n,) the recording, whitened."""
        return self.whiten(self.recording)

    def heard(self, model: EchoModel) -> tuple[Samples, Samples]:
        """(n,), (n,) what a model predicts for the reference, and that whitened; remembered for the latest few models, not to be written to."""
        known = self._heard.pop(model, None)
        if known is None:
            predicted = model.predict(self.reference)
            known = predicted, self.whiten(predicted)
            while len(self._heard) >= REMEMBERED:
                del self._heard[next(iter(self._heard))]
        self._heard[model] = known
        return known

    def error(self, predicted: Samples) -> float:
        """Weighted sum of squares of the whitened recording minus predicted (n,): what a fit makes small."""
        residual = self.whiten(self.recording - predicted)
        return float(np.dot(residual * residual, self.weights))


def whiten(x: Samples, noise_psd: Samples) -> Samples:
    """x (n,) filtered by 1 / sqrt(noise_psd), zero-phase, so that noise of that one-sided PSD gets variance 1.

    The PSD is floored, so that a notch is not amplified beyond reason.
    """
    taps = np.fft.fftshift(np.fft.irfft(1.0 / np.sqrt(floored(noise_psd) * SAMPLE_RATE / 2)))[1:]
    taps *= np.hanning(taps.size + 2)[1:-1] ** 0.25
    return scipy.signal.oaconvolve(x, taps.astype(np.float32), mode="full")[taps.size // 2 :][: x.size].astype(np.float32)


class Effect(Protocol):
    """One physical effect on the robot's own voice. With every parameter at its neutral value, apply is the identity.

    Stage "source" acts on the reference, "path", "time" and "microphone" on the predicted voice at the microphone. An effect of stage
    "noise" leaves apply the identity and offers one of these instead: noise_psd(values, psd) -> (601,), the fan's PSD after it;
    variance(reference, values, sample_rate) -> (n,), what it adds to the expected square of each sample, and colour(values) -> (601,), the
    density of that per Hz, 0 to 8 kHz, with an integral of 1. An effect of stage "source"
    that is not memoryless may name a memory, samples of the past that it needs: then the running filter applies it, too. One of stage
    "microphone" that gives the fan the same gain as the voice says scales_fan = True.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    memoryless: ClassVar[bool]
    parameters: ClassVar[tuple[Parameter, ...]]

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """The signal (n,) after the effect; x is not written to."""
        ...

    def fit(self, measurement: Measurement, model: EchoModel) -> Values:
        """Values with which the model, this effect added, comes closest to the recording (least squares)."""
        ...


_REGISTRY: dict[str, Effect] = {}


def register(effect: Effect) -> None:
    """Make an effect known by its name; raises UsageError where the name is taken or a neutral value is out of bounds."""
    if effect.name in _REGISTRY:
        raise UsageError(f"effect '{effect.name}' is defined twice: rename one of them")
    for p in effect.parameters:
        if not p.low <= p.neutral <= p.high:
            raise UsageError(f"effect {effect.name}: neutral {p.name}={p.neutral:g} is outside {p.low:g} to {p.high:g}")
    _REGISTRY[effect.name] = effect


def names() -> tuple[str, ...]:
    """All known effects."""
    return tuple(_REGISTRY)


def find(name: str) -> Effect:
    """The effect of that name; raises UsageError with the known names."""
    if name not in _REGISTRY:
        raise UsageError(f"unknown effect '{name}': choose one of {', '.join(sorted(_REGISTRY))}")
    return _REGISTRY[name]


def neutral(effect: Effect) -> dict[str, float]:
    """The values at which an effect vanishes."""
    return {p.name: p.neutral for p in effect.parameters}


def complete(effect: Effect, values: Values) -> dict[str, float | Array]:
    """values with the neutral value for each that is missing; raises UsageError for unknown names and values out of bounds."""
    known = {p.name: p for p in effect.parameters}
    for name, value in values.items():
        if name not in known:
            raise UsageError(f"effect {effect.name} has no parameter '{name}': it takes {', '.join(known)}")
        p, found = known[name], np.asarray(value, float)
        if not ((found >= p.low) & (found <= p.high)).all():
            raise UsageError(f"effect {effect.name}: {name} is {value} {p.unit}, expected {p.low:g} to {p.high:g}")
    return {**neutral(effect), **{name: value if np.ndim(value) == 0 else np.asarray(value, float) for name, value in values.items()}}


def level_ratio(recording: Samples, predicted: Samples) -> float:
    """Least-squares gain from predicted to recording, both (n,); 1 where nothing was predicted."""
    energy = float(np.dot(predicted, predicted))
    return float(np.dot(recording, predicted)) / energy if energy > 0.0 else 1.0
