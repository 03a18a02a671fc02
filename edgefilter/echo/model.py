"""EchoModel: the robot's own voice at the microphone as a chain of physical effects around a linear path."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile
from typing import TypeAlias

import numpy as np

from edgefilter.dsp.convolution import filtered
from edgefilter.echo.effect import RECORDING, Effect, Shift, complete, vanishes
from edgefilter.echo.effects.catalogue import chain, find
from edgefilter.echo.measurement import Measurement, Values
from edgefilter.echo.running import is_filter
from edgefilter.echo.wiener import LONGEST
from edgefilter.types import SAMPLE_RATE, Array, Samples

LEAD = 1024
"""Samples (64 ms) by which filters may begin before the impulse response does."""

Chain: TypeAlias = Sequence[tuple[Effect, Values]]


@dataclass(frozen=True, eq=False)
class EchoModel:
    """A linear path and the effects around it.

    impulse_response: (taps,) float32 from the reference to the microphone, starting PRE_ROLL samples before the direct
    sound. effects: (name, values) in the order in which they were added; they are applied in the catalogue's.
    """

    impulse_response: Samples
    effects: tuple[tuple[str, Values], ...] = ()

    def predict(self, reference: Samples) -> Samples:
        """The robot's voice at the microphone (n,) for an aligned reference (n,), all effects applied."""
        ahead, paths, lead, behind = self._chain
        x, n = through(ahead, reference), reference.size
        played = np.zeros(n, np.float32)
        for path, changing in paths:
            heard = filtered(x, path, lead)
            share = None if changing is None else changing[0].share(changing[1], n, SAMPLE_RATE)
            played += heard if share is None else share * heard
        return through(behind, played)

    @property
    def as_filter(self) -> tuple[Samples, int] | None:
        """The filter (taps,) that does what predict() does, and the samples by which it leads; None where that is not linear or changes with time."""
        ahead, ((path, _), *later), lead, behind = self._chain
        return None if ahead or later or behind else (path, lead)

    @cached_property
    def _chain(self) -> tuple[Chain, list[tuple[Samples, tuple[Effect, Values] | None]], int, Chain]:
        """The model as a sequence: effects before the path; impulse responses (taps,); index of time zero in each; effects after the path.

        The first response is the path, each other what an event adds to it, with its effect. Linear effects that follow the path directly are
        convolved into all of them.
        """
        ahead, on_it, behind = self._by_stage
        path = self.response()
        later = [pair for pair in on_it if pair[0].event]
        longer = np.pad(path, (0, LONGEST))
        paths = [(path, None), *((_trimmed(e.apply(longer, v, SAMPLE_RATE) - longer), (e, v)) for e, v in later)]
        filters = list(takewhile(lambda pair: pair[0].absorbed, behind))
        if not filters:
            return ahead, paths, 0, behind
        whole = [(_trimmed(through(filters, np.pad(each, (LEAD, LONGEST)))), changing) for each, changing in paths]
        return ahead, whole, LEAD, behind[len(filters) :]

    @property
    def _by_stage(self) -> tuple[Chain, Chain, Chain]:
        """The effects ahead of the path, those of its response, and those behind it."""
        applied = chain(self.effects)
        ahead, on_it = ([pair for pair in applied if pair[0].stage == stage] for stage in ("source", "response"))
        return ahead, on_it, applied[len(ahead) + len(on_it) :]

    def response(self) -> Samples:
        """The impulse response with the effects of stage "response" that hold from the start, (taps,)."""
        return self._response_with([pair for pair in self._by_stage[1] if not pair[0].event], 1e-6)

    def _response_with(self, effects: Chain, share: float) -> Samples:
        """The impulse response behind effects, up to the last tap that exceeds that share of its largest, (taps,)."""
        if not effects:
            return self.impulse_response
        response = through(effects, np.pad(self.impulse_response, (0, LONGEST)))
        return response[: max(self.impulse_response.size, _heard(response, share))]

    def over(self, response: Samples) -> EchoModel:
        """The model with this response (taps,) in place of its own."""
        return replace(self._with_those(lambda name, _: find(name).stage != "response"), impulse_response=response)

    def unpredictable(self, reference: Samples) -> tuple[tuple[Samples, Array], ...]:
        """Of each source of the noise that effects add: its expected square (n,) at the microphone, and its density (601,) per Hz of integral 1."""
        applied = chain(self.effects)
        noisy = [(effect, values) for effect, values in applied if effect.adds_noise]
        if not noisy:
            return ()
        moved = [(e, v) for e, v in applied if e.stage == "time" or (e.stage == "source" and not e.adds_noise)]
        x = through(moved, reference)
        added = [(effect.variance(x, values, SAMPLE_RATE), effect.colour(values)) for effect, values in noisy]
        return tuple(source for each in added for source in zip(*map(np.atleast_2d, each), strict=True))

    def running_response(self) -> Samples:
        """The path with the effects on it that are filters, as after the last change, (taps,): what the running filter starts from."""
        linear = [(effect, values) for effect, values in chain(self.effects) if is_filter(effect, values)]
        return self._response_with(linear, 1e-4)

    def with_running_response(self, response: Samples, gain: float = 1.0) -> EchoModel:
        """The model whose running_response() begins with response (taps,) and goes on as that of this one times gain.

        The effects that are filters are in its impulse response, and no longer listed.
        """
        rest = self.running_response()[response.size :] * np.float32(gain)
        folded = (effect.name for effect, values in chain(self.effects) if is_filter(effect, values))
        whole = np.concatenate((response, rest)).astype(np.float32)
        return replace(self.without_effect(*folded), impulse_response=whole)

    def components(self, reference: Samples) -> dict[str, Samples]:
        """What each part contributes to predict(reference), (n,) each: "linear", the path alone, then the change by each effect in turn."""
        parts = {"linear": replace(self, effects=()).predict(reference)}
        before = parts["linear"]
        for count, (name, _) in enumerate(self.effects, start=1):
            after = replace(self, effects=self.effects[:count]).predict(reference)
            parts[name] = after - before
            before = after
        return parts

    def microphone_gain(self, size: int) -> Samples:
        """The gain that effects behind the microphone give voice and fan alike at each moment, (size,), ones without any."""
        scaling = [(effect, values) for effect, values in chain(self.effects) if effect.scales_fan]
        return through(scaling, np.ones(size, np.float32))

    def fan(self, noise: Samples) -> Samples:
        """The fan's sound (n,) throughout the recording, made of noise (n,), the fan as at its end; noise itself where the fan never changes."""
        for effect, values in chain(self.effects):
            if effect.stage == "noise":
                noise = effect.passed(noise, noise, values, SAMPLE_RATE)
        return noise

    def passed(self, noise: Samples, reference: Samples) -> Samples:
        """What the effects let through of the fan's sound (n,) beside the voice of an aligned reference (n,); noise itself where that is all."""
        applied = chain(self.effects)
        for place, (effect, values) in enumerate(applied):
            if effect.scales_fan:
                noise = effect.apply(noise, values, SAMPLE_RATE)
            elif effect.shows_in_silence:
                ahead = replace(self, effects=tuple((other.name, known) for other, known in applied[:place]))
                noise = effect.passed(noise, ahead.predict(reference), values, SAMPLE_RATE)
        return noise

    def expected_noise(self, psd: Samples) -> Samples:
        """PSD of the fan with the model's effects on it, (601,), from psd (601,) of the calibration."""
        for effect, values in chain(self.effects):
            psd = effect.noise_psd(values, psd)
        return psd

    @property
    def timed(self) -> bool:
        """Whether an effect counts its times from the beginning of the recording, as a jump does."""
        return any(find(name).timed for name, _ in self.effects)

    def with_effect(self, name: str, values: Values) -> EchoModel:
        """The model with that effect added, or its values replaced; missing values are neutral.

        Raises UsageError for an unknown effect, an unknown parameter or a value out of bounds.
        """
        entry = (name, complete(find(name), values))
        return replace(self, effects=(*self.without_effect(name).effects, entry))

    def with_effects(self, names: Iterable[str], values: Mapping[str, Values]) -> EchoModel:
        """The model with the effects of these names added, each with its values."""
        model = self
        for name in names:
            model = model.with_effect(name, values[name])
        return model

    def without_effect(self, *names: str) -> EchoModel:
        """The model without those effects."""
        return self._with_those(lambda name, _: name not in names)

    def _with_those(self, kept: Callable[[str, Values], bool]) -> EchoModel:
        """Only those effects; the model itself where that is all, so that what is remembered of it is found again."""
        effects = tuple(entry for entry in self.effects if kept(*entry))
        return self if len(effects) == len(self.effects) else replace(self, effects=effects)

    def fit(self, name: str, measurement: Measurement) -> EchoModel:
        """The model with that effect at the values that explain the measurement best."""
        return self.with_effect(name, self.without_effect(name).fitted(name, measurement))

    def fitted(self, name: str, measurement: Measurement) -> dict[str, float | Array]:
        """All values of an effect that the model has not, as they explain the measurement best.

        It is fitted behind the effects that the catalogue puts ahead of it. An event's values say in which recording it happened.
        """
        effect, behind, model = find(name), measurement, self
        if effect.stage in ("source", "response"):
            before = takewhile(lambda pair: pair[0] is not effect, chain((*self.effects, (name, {}))))
            ahead = [pair for pair in before if pair[0].stage == "source"]
            if ahead:
                behind = replace(measurement, reference=through(ahead, measurement.reference))
            model = model.without_effect(*(other.name for other, _ in ahead))
        values = complete(effect, effect.fit(behind, model))
        if RECORDING in effect.parameters and not vanishes(effect, values):
            values[RECORDING.name] = measurement.fingerprint
        return values

    @cached_property
    def still(self) -> EchoModel:
        """The model without the effects that only move what is heard in time; itself where it has none."""
        return self._with_those(lambda name, _: not isinstance(find(name), Shift))

    def read_at(self, size: int) -> Array:
        """Where in the prediction of `still` each sample of this model's prediction is read, (size,)."""
        read = n = np.arange(float(size))
        for effect, values in reversed(chain(self.effects)):
            if isinstance(effect, Shift):
                read = np.interp(read, n, effect.read_at(values, size, SAMPLE_RATE))
        return read

    def lasting(self) -> EchoModel:
        """What holds of the robot in any recording: the model without its events."""
        return self._as_in(())

    def during(self, measurement: Measurement) -> EchoModel:
        """The model without the events of other recordings: a jump does not come again at the same second of another one."""
        return self._as_in((0.0, measurement.fingerprint))

    def _as_in(self, recordings: Sequence[float]) -> EchoModel:
        """The model without what was fitted to other recordings than those with these fingerprints; itself where there is nothing of that kind."""
        known = [(n, v if v.get(RECORDING.name) in recordings else find(n).elsewhere(v)) for n, v in self.effects]
        effects = tuple((name, values) for name, values in known if values is not None)
        same = len(effects) == len(self.effects) and all(
            a[1] is b[1] for a, b in zip(effects, self.effects, strict=True)
        )
        return self if same else replace(self, effects=effects)


def through(effects: Chain, x: Samples) -> Samples:
    """A signal (n,) behind effects, (n,)."""
    for effect, values in effects:
        x = effect.apply(x, values, SAMPLE_RATE)
    return x


def _trimmed(response: Samples) -> Samples:
    """A response up to its last tap that is heard at all."""
    return response[: max(_heard(response, 1e-6), 1)]


def _heard(response: Samples, share: float) -> int:
    """Taps of a response up to the last that exceeds that share of its largest, 0 where all are zero."""
    above = np.flatnonzero(np.abs(response) > share * np.abs(response).max(initial=0.0))
    return int(above[-1]) + 1 if above.size else 0
