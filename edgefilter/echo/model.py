"""EchoModel: the robot's own voice at the microphone as a chain of physical effects around a linear path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile
from typing import TypeAlias

import numpy as np

from edgefilter.dsp.convolution import convolve
from edgefilter.echo.effect import RECORDING, Effect, complete, vanishes
from edgefilter.echo.effects.catalogue import chain, find
from edgefilter.echo.measurement import Measurement, Values
from edgefilter.echo.running import is_filter
from edgefilter.types import SAMPLE_RATE, Array, Samples

LEAD, TAIL = 1024, 12800
"""Samples (64 ms, 0.8 s) by which filters may begin before the impulse response does, and lengthen it."""

Chain: TypeAlias = Sequence[tuple[Effect, Values]]


@dataclass(frozen=True, eq=False)
class EchoModel:
    """A linear path and the effects around it.

    impulse_response: (taps,) float32 from the reference to the microphone, starting PRE_ROLL samples before the direct
    sound.
    effects: (name, values) in the order in which they were added; applied they are in the catalogue's, so that the
    order in which effects were found changes nothing that is predicted.
    """

    impulse_response: Samples
    effects: tuple[tuple[str, Values], ...] = ()

    def predict(self, reference: Samples) -> Samples:
        """The robot's voice at the microphone (n,) for an aligned reference (n,), all effects applied."""
        ahead, path, lead, behind = self._chain
        played = convolve(_through(ahead, reference), path)[lead:][: reference.size]
        return _through(behind, played.astype(np.float32, copy=False))

    @cached_property
    def _chain(self) -> tuple[Chain, Samples, int, Chain]:
        """Effects ahead of the path; the path with the filters right behind it, (taps,); the samples by which it begins early; effects behind.

        One convolution in place of several is what makes a search fast.
        """
        applied = chain(self.effects)
        ahead = [pair for pair in applied if pair[0].stage == "source"]
        behind = applied[len(ahead) :]
        filters = list(takewhile(lambda pair: pair[0].absorbed, behind))
        if not filters:
            return ahead, self.impulse_response, 0, behind
        path = np.pad(self.impulse_response, (LEAD, TAIL))
        for effect, values in filters:
            path = effect.apply(path, values, SAMPLE_RATE)
        size = max(LEAD + self.impulse_response.size, _heard(path, 1e-6))
        return ahead, path[:size], LEAD, behind[len(filters) :]

    def unpredictable(self, reference: Samples) -> tuple[tuple[Samples, Array], ...]:
        """Of each source of the noise that effects add: its expected square (n,) at the microphone, and its density (601,) per Hz of integral 1."""
        applied = chain(self.effects)
        noisy = [(effect, values) for effect, values in applied if effect.adds_noise]
        if not noisy:
            return ()
        x = reference
        for effect, values in applied:
            if effect.stage == "time" or (effect.stage == "source" and not effect.adds_noise):
                x = effect.apply(x, values, SAMPLE_RATE)
        added = [(effect.variance(x, values, SAMPLE_RATE), effect.colour(values)) for effect, values in noisy]
        return tuple(source for each in added for source in zip(*map(np.atleast_2d, each), strict=True))

    def running_response(self) -> Samples:
        """The path with the effects on it that are filters, as after the last change, (taps,): what the running filter starts from."""
        linear = [(effect, values) for effect, values in chain(self.effects) if is_filter(effect, values)]
        if not linear:
            return self.impulse_response
        response = np.pad(self.impulse_response, (0, TAIL))
        for effect, values in linear:
            response = effect.apply(response, effect.settled(values), SAMPLE_RATE)
        return response[: max(self.impulse_response.size, _heard(response, 1e-4))]

    def with_running_response(self, response: Samples, gain: float = 1.0) -> EchoModel:
        """The model whose running_response() begins with response (taps,) and goes on as that of this one times gain.

        The effects that are filters have been applied to both parts and cannot be taken out again (a band limit has no
        inverse); they are in the impulse response now, and listing them would apply them twice.
        """
        rest = self.running_response()[response.size :] * np.float32(gain)
        folded = {effect.name for effect, values in chain(self.effects) if is_filter(effect, values)}
        kept = tuple(entry for entry in self.effects if entry[0] not in folded)
        return replace(self, impulse_response=np.concatenate((response, rest)).astype(np.float32), effects=kept)

    def components(self, reference: Samples) -> dict[str, Samples]:
        """What each part contributes, (n,) each: "linear", the path alone, then by how much each effect in turn changes it.

        The sum of all components is predict(reference).
        """
        parts = {"linear": replace(self, effects=()).predict(reference)}
        before = parts["linear"]
        for count, (name, _) in enumerate(self.effects, start=1):
            after = replace(self, effects=self.effects[:count]).predict(reference)
            parts[name] = after - before
            before = after
        return parts

    def microphone_gain(self, size: int) -> Samples:
        """The gain that an effect behind the microphone gives voice and fan alike at each moment, (size,).

        Ones without one.
        """
        gain = np.ones(size, np.float32)
        for effect, values in chain(self.effects):
            if effect.scales_fan:
                gain = effect.apply(gain, values, SAMPLE_RATE)
        return gain

    def expected_noise(self, psd: Samples) -> Samples:
        """PSD of the fan with the model's effects on it, (601,), from psd (601,) of the calibration."""
        for effect, values in chain(self.effects):
            psd = effect.noise_psd(values, psd)
        return psd

    @property
    def timed(self) -> bool:
        """Whether what the model predicts depends on when the recording began."""
        return any(find(name).timed for name, _ in self.effects)

    def with_effect(self, name: str, values: Values) -> EchoModel:
        """The model with that effect added, or its values replaced; missing values are neutral.

        Raises UsageError for an unknown effect, an unknown parameter or a value out of bounds.
        """
        entry = (name, complete(find(name), values))
        return replace(self, effects=(*(kept for kept in self.effects if kept[0] != name), entry))

    def without_effect(self, name: str) -> EchoModel:
        """The model without that effect."""
        return replace(self, effects=tuple(kept for kept in self.effects if kept[0] != name))

    def fit(self, name: str, measurement: Measurement) -> EchoModel:
        """The model with that effect at the values that explain the measurement best."""
        return self.with_effect(name, self.without_effect(name).fitted(name, measurement))

    def fitted(self, name: str, measurement: Measurement) -> dict[str, float | Array]:
        """All values of an effect that the model has not, as they explain the measurement best.

        It is fitted behind the effects that the catalogue puts ahead of it. The values of an event, unless it vanishes, say in
        which recording it happened.
        """
        effect, behind, model = find(name), measurement, self
        if effect.stage == "source":
            ahead = list(takewhile(lambda pair: pair[0] is not effect, chain((*self.effects, (name, {})))))
            if ahead:
                behind = replace(measurement, reference=_through(ahead, measurement.reference))
            for other, _ in ahead:
                model = model.without_effect(other.name)
        values = complete(effect, effect.fit(behind, model))
        if effect.event and not vanishes(effect, values):
            values[RECORDING.name] = measurement.fingerprint
        return values

    def lasting(self) -> EchoModel:
        """The model without its events: what holds of the robot in any recording."""
        return replace(self, effects=tuple((name, values) for name, values in self.effects if not find(name).event))

    def during(self, measurement: Measurement) -> EchoModel:
        """The model without the events of other recordings: a jump or a moment's move does not come again at the same second of another one."""
        here = (0.0, measurement.fingerprint)
        kept = tuple(
            (name, values)
            for name, values in self.effects
            if not find(name).event or values.get(RECORDING.name, 0.0) in here
        )
        return self if len(kept) == len(self.effects) else replace(self, effects=kept)


def _through(effects: Chain, x: Samples) -> Samples:
    """A signal (n,) behind effects, (n,)."""
    for effect, values in effects:
        x = effect.apply(x, values, SAMPLE_RATE)
    return x


def _heard(response: Samples, share: float) -> int:
    """Taps of a response up to the last that exceeds that share of its largest, 0 where all are zero."""
    above = np.flatnonzero(np.abs(response) > share * np.abs(response).max(initial=0.0))
    return int(above[-1]) + 1 if above.size else 0
