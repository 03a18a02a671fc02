"""EchoModel: the robot's own voice at the microphone as a chain of physical effects around a linear path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from edgefilter.echo.effect import STAGES, Measurement, Values, complete, find
from edgefilter.echo.effects import catalogue
from edgefilter.echo.source_chain import Driver
from edgefilter.types import SAMPLE_RATE, Array, Samples

TAIL = 12800
"""Samples (0.8 s) by which an effect may lengthen the impulse response."""


@dataclass(frozen=True, eq=False)
class EchoModel:
    """A linear path and the effects around it.

    impulse_response: (taps,) float32 from the reference to the microphone, starting PRE_ROLL samples before the direct sound.
    effects: (name, values) in the order in which they were added.
    """

    impulse_response: Samples
    effects: tuple[tuple[str, Values], ...] = ()

    def predict(self, reference: Samples) -> Samples:
        """The robot's voice at the microphone (n,) for an aligned reference (n,), all effects applied."""
        return self._predict(reference, self.effects)

    def unpredictable(self, reference: Samples) -> tuple[tuple[Samples, Array], ...]:
        """Of each effect that adds noise of its own: its expected square (n,) at the microphone, and its density (601,) per Hz of integral 1."""
        chain = sorted(((find(name), complete(find(name), values)) for name, values in self.effects), key=lambda pair: STAGES.index(pair[0].stage))
        noisy = [(effect, values) for effect, values in chain if hasattr(effect, "variance")]
        if not noisy:
            return ()
        x = reference
        for effect, values in chain:
            if effect.stage == "time" or (effect.stage == "source" and not hasattr(effect, "variance")):
                x = effect.apply(x, values, SAMPLE_RATE)
        return tuple((effect.variance(x, values, SAMPLE_RATE), effect.colour(values)) for effect, values in noisy)

    def driver(self) -> Driver:
        """What the running filter puts the reference through, hop by hop, before the path: the source effects with a short memory."""
        return Driver(self.effects)

    def running_response(self) -> Samples:
        """(taps,) the path with all stationary linear effects folded in, as after the last change: what the running filter starts from."""
        chain = [(find(name), values) for name, values in self.effects]
        chain = [(effect, complete(effect, values)) for effect, values in chain if effect.stage == "path"]
        if not chain:
            return self.impulse_response
        response = np.pad(self.impulse_response, (0, TAIL))
        for effect, values in chain:
            settled = getattr(effect, "settled", None)
            response = effect.apply(response, settled(values) if settled else values, SAMPLE_RATE)
        heard = np.flatnonzero(np.abs(response) > 1e-4 * np.abs(response).max(initial=0.0))
        return response[: max(self.impulse_response.size, int(heard[-1]) + 1 if heard.size else 0)]

    def with_running_response(self, response: Samples, gain: float = 1.0) -> EchoModel:
        """The model whose running_response() begins with response (taps,) and goes on as that of this one times gain.

        The path effects have been applied to both parts and cannot be taken out again (a band limit has no inverse);
        they are in the impulse response now, and listing them would apply them twice.
        """
        rest = self.running_response()[response.size :] * np.float32(gain)
        kept = tuple(entry for entry in self.effects if find(entry[0]).stage != "path")
        return replace(self, impulse_response=np.concatenate((response, rest)).astype(np.float32), effects=kept)

    def components(self, reference: Samples) -> dict[str, Samples]:
        """What each part contributes, (n,) each: "linear", the path alone, then by how much each effect in turn changes it.

        The sum of all components is predict(reference).
        """
        parts = {"linear": self._predict(reference, ())}
        before = parts["linear"]
        for count, (name, _) in enumerate(self.effects, start=1):
            after = self._predict(reference, self.effects[:count])
            parts[name] = after - before
            before = after
        return parts

    def microphone_gain(self, size: int) -> Samples:
        """(size,) the gain that an effect behind the microphone gives voice and fan alike at each moment; ones without one."""
        gain = np.ones(size, np.float32)
        for name, values in self.effects:
            effect = find(name)
            if getattr(effect, "scales_fan", False):
                gain = effect.apply(gain, complete(effect, values), SAMPLE_RATE)
        return gain

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
        return self.with_effect(name, find(name).fit(measurement, self.without_effect(name)))

    def _predict(self, reference: Samples, effects: tuple[tuple[str, Values], ...]) -> Samples:
        """Source effects, the path, then the rest in the order in which sound meets them."""
        x = reference
        chain = sorted(((find(name), values) for name, values in effects), key=lambda pair: STAGES.index(pair[0].stage))
        for effect, values in chain:
            if effect.stage == "source":
                x = effect.apply(x, complete(effect, values), SAMPLE_RATE)
        x = scipy.signal.oaconvolve(x, self.impulse_response)[: reference.size].astype(np.float32)
        for effect, values in chain:
            if effect.stage != "source":
                x = effect.apply(x, complete(effect, values), SAMPLE_RATE)
        return x


catalogue.load()
