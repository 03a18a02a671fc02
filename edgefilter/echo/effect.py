"""What one physical effect has to offer, and the registry in which effects are found by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol, TypeAlias

import numpy as np

from edgefilter.errors import UsageError
from edgefilter.types import Array, Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel

Values: TypeAlias = Mapping[str, "float | Array"]
Stage: TypeAlias = Literal["source", "path", "time", "microphone", "noise"]
STAGES: tuple[Stage, ...] = ("source", "path", "time", "microphone", "noise")
"""In the order in which sound meets them."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect: its unit, the value at which the effect vanishes, and the values that are possible."""

    name: str
    unit: str
    neutral: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Measurement:
    """The robot alone: reference (n,), already aligned, and the recording (n,) of it, float32."""

    reference: Samples
    recording: Samples


class Effect(Protocol):
    """One physical effect on the robot's own voice. With every parameter at its neutral value, apply is the identity."""

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
    return {**neutral(effect), **values}


def level_ratio(recording: Samples, predicted: Samples) -> float:
    """Least-squares gain from predicted to recording, both (n,); 1 where nothing was predicted."""
    energy = float(np.dot(predicted, predicted))
    return float(np.dot(recording, predicted)) / energy if energy > 0.0 else 1.0
