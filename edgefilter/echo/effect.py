"""One physical effect on the robot's own voice: the base class, whose hooks are all that the rest of the package knows of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, TypeAlias, get_args

import numpy as np

from edgefilter.dsp.fractional_delay import interpolate
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.errors import UsageError
from edgefilter.types import Array, Samples

Stage: TypeAlias = Literal["source", "response", "path", "time", "microphone", "noise"]
STAGES: tuple[Stage, ...] = get_args(Stage)
"""In the order in which sound meets them."""
Family: TypeAlias = Literal[
    "static nonlinearity", "dynamics", "linear path", "time", "modulation", "additive noise", "of your own"
]
"""A curve that each sample goes through, a gain by level, a filter, the clock, a gain by time, noise; your own need not say."""
FAMILIES: tuple[Family, ...] = get_args(Family)
NEVER_S = 1e6
"""Seconds: a moment that no recording reaches, ten days, as the value of an event that does not happen."""
NEVER_REACHED = 100.0
"""Full scale: an amplitude that no signal reaches, 40 dB over the largest sample, as the value of a bound that does nothing."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect, or an array of such numbers: unit, the value at which the effect vanishes, the least and the largest.

    given: whether it is taken over from elsewhere, such as the calibrated fan, rather than fitted.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    given: bool = False


RECORDING = Parameter("recording", "fingerprint", 0.0, 0.0, 2.0**52, given=True)
"""Every event's last parameter: the recording in which it happened (Measurement.fingerprint); 0 for any."""


class Runner(Protocol):
    """One effect at work on a stream: what it remembers it carries on from one hop to the next."""

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        """The next samples x (n,) after the effect. heard: the microphone's (n,) of the same moment, None ahead of the path."""


class Effect:
    """One physical effect on the robot's own voice. With every parameter at its neutral value, apply is the identity.

    A subclass gives name, stage and parameters, and overrides what differs from the defaults below; no other module
    knows an effect by name. Stage "source" acts on the reference, "response" on the impulse response itself, "path",
    "time" and "microphone" on the predicted voice at the microphone; "noise" changes the noise that is expected and
    leaves the voice alone.

    What the model asks:
    memory: samples of the past that apply needs on a stream at every hop, 0 for none. None where that is not known, or
    too much: then the running filter asks run(), or tries how many are enough (echo/running.py).
    run_note: a sentence on what the running filter makes of the effect, where that is not what apply does.
    event: whether the values belong to one recording (moments, a gain's curve) rather than to the robot: they get a
    parameter RECORDING besides their own, and in other recordings the effect is left out. followed: whether the running
    filter follows it by itself, as its aligner does a drift: it does not ask for variance(), and a fit of other effects
    takes it out of the recording first (diagnosis/joint.py).

    What the diagnosis asks:
    title: how it reads inside a sentence ("a turned volume"); by default the name. complexity: of two effects that
    explain about as much the lower one is named. flexible: whether it has so many numbers that it takes up what a simpler
    effect beside it does. free: whether it is the law of a family rather than an effect (free_laws.py): no search tries it.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    parameters: ClassVar[tuple[Parameter, ...]]

    memory: ClassVar[int | None] = None
    run_note: ClassVar[str] = ""
    event: ClassVar[bool] = False
    followed: ClassVar[bool] = False

    family: ClassVar[Family] = "of your own"
    title: ClassVar[str] = ""
    complexity: ClassVar[int] = 3
    flexible: ClassVar[bool] = False
    free: ClassVar[bool] = False

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """The signal (n,) after the effect; x is not written to. By default what run() makes of all of x, or a copy of x without run()."""
        stream = self.run(values, sample_rate)
        return x.copy() if stream is None else stream(x)

    def run(self, values: Values, sample_rate: int) -> Runner | None:
        """The effect on a stream, for one that remembers much or follows what the microphone hears; None: apply is all there is."""
        return None

    def share(self, values: Values, size: int, sample_rate: int) -> Samples | None:
        """Of stage "response": how much of its change holds at each sample, (size,) 0 to 1; None, by default, for all of it always."""
        return None

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Values with which the model, this effect added, comes closest to the recording; the neutral ones where it shows no sign of it."""
        return neutral(self)

    def noise_psd(self, values: Values, psd: Samples) -> Samples:
        """The fan's PSD (601,) with the effect, from psd (601,) without it."""
        return psd

    def variance(self, reference: Samples, values: Values, sample_rate: int) -> Samples:
        """What the effect adds to the expected square of each sample (n,) at the microphone, for an aligned reference (n,).

        (k, n) where it is the sum of k, each with a colour of its own.
        """
        return np.zeros(reference.size, np.float32)

    def colour(self, values: Values) -> Array:
        """Spectral density per Hz of what `variance` says is added, (601,), 0 to 8 kHz, integral 1; (k, 601) of k such. White by default."""
        return np.full(601, 1.0 / 8000.0)

    def passed(self, noise: Samples, voice: Samples, values: Values, sample_rate: int) -> Samples:
        """The fan's sound (n,), given as it is at the end of the recording without this effect, as it is heard beside a voice (n,).

        A gain by level behind the microphone turns it down; a fan that changed later on sounded differently before. By default as given.
        """
        return noise

    def elsewhere(self, values: Values) -> Values | None:
        """The values to use in other recordings than the one they were fitted to; None to leave the effect out, as by default of an event."""
        return None if self.event else values

    def sentence(self, values: Values) -> str:
        """What in a recording speaks for the effect, with figures; empty: nothing but that the residual falls."""
        return ""

    def only(self, values: Values) -> Values:
        """Values without what a flexible fit has taken up of another effect; by default as they are."""
        return values

    def __init_subclass__(cls, **named: object) -> None:
        super().__init_subclass__(**named)
        own = vars(cls).get("parameters")
        if cls.event and isinstance(own, tuple) and RECORDING not in own:
            cls.parameters = (*own, RECORDING)

    @property
    def told(self) -> tuple[Parameter, ...]:
        """The parameters that a report shows."""
        return tuple(p for p in self.parameters if not p.given)

    @property
    def absorbed(self) -> bool:
        """Whether a linear path that is fitted to a recording holds the effect already."""
        return self.family == "linear path" and not self.event

    @property
    def scales_fan(self) -> bool:
        """Whether the fan gets the same gain as the voice: a gain by time behind the microphone."""
        return self.stage == "microphone" and self.event

    @property
    def shows_in_silence(self) -> bool:
        """Whether silences tell it together with the voice: a gain by level behind the microphone (passed())."""
        return self.stage == "microphone" and self.family == "dynamics" and not self.event

    @property
    def learned(self) -> bool:
        """Whether the running filter fits it anew to what it hears: the curve of a loudspeaker."""
        return self.stage == "source" and self.family == "static nonlinearity" and not self.free

    @property
    def adds_noise(self) -> bool:
        """Whether variance() is more than nothing."""
        return type(self).variance is not Effect.variance

    @property
    def last_resort(self) -> bool:
        """Whether it is tried only where no other explains much: noise that no waveform predicts fits whatever is left."""
        return self.adds_noise or self.stage == "noise"

    @property
    def timed(self) -> bool:
        """Whether what it does depends on when the recording began."""
        return self.event or self.stage == "time"


class Shift(Effect):
    """An effect that only shifts sound in time, so that a recording can be read as it was ahead of it."""

    stage = "time"
    family = "time"

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """The signal x (n,), read at other moments."""
        return x.copy() if vanishes(self, values) else interpolate(x, self.read_at(values, x.size, sample_rate))

    def read_at(self, values: Values, size: int, sample_rate: int) -> Array:
        """Where in x each of its output samples is read, (size,), rising."""
        raise NotImplementedError


def neutral(effect: Effect) -> dict[str, float]:
    """The values at which an effect vanishes."""
    return {p.name: p.neutral for p in effect.parameters}


def complete(effect: Effect, values: Values) -> dict[str, float | Array]:
    """Return the values, with the neutral value for each that is missing.

    Raises UsageError for unknown names and values out of bounds.
    """
    known = {p.name: p for p in effect.parameters}
    for name, value in values.items():
        if name not in known:
            raise UsageError(f"effect {effect.name} has no parameter '{name}': it takes {', '.join(known)}")
        p, found = known[name], np.asarray(value, float)
        if not ((found >= p.low) & (found <= p.high)).all():
            raise UsageError(f"effect {effect.name}: {name} is {value} {p.unit}, expected {p.low:g} to {p.high:g}")
    return {
        **neutral(effect),
        **{name: value if np.ndim(value) == 0 else np.asarray(value, float) for name, value in values.items()},
    }


def vanishes(effect: Effect, values: Values) -> bool:
    """Whether all values are the neutral ones."""
    return all(np.array_equal(values[name], value) for name, value in neutral(effect).items())


def within(effect: Effect, values: Values) -> dict[str, float | Array]:
    """The values, each held within its bounds."""
    held = {p.name: np.clip(values[p.name], p.low, p.high) for p in effect.parameters if p.name in values}
    return {name: value if value.ndim else float(value) for name, value in held.items()}


def first(values: Values, name: str) -> float:
    """A parameter as one number: the first where it holds several."""
    return float(np.ravel(values[name])[0])


def numbers(values: Values, name: str, size: int | None = None) -> Array:
    """A parameter, one number or several, as an array (k,) float64; with `size` a single number is repeated (read-only) to (size,)."""
    found = np.atleast_1d(np.asarray(values[name], float))
    return found if size is None else np.broadcast_to(found, size)
