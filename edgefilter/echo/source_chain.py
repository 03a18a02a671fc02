"""The reference, hop by hop, as the loudspeaker's linear part gets it, and what no waveform predicts of what it sets off."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from edgefilter.echo.effect import Runner
from edgefilter.echo.effects.catalogue import chain
from edgefilter.echo.measurement import Values
from edgefilter.echo.running import ExpectedSquare, Windowed, stream_form
from edgefilter.types import SAMPLE_RATE, Array, Samples

LONG_MEMORY = SAMPLE_RATE
"""Samples of the past from which an effect with its own way of running begins anew: two release times of a slow
compressor."""


class SourceChain:
    """Applies the source effects of a model to successive blocks, and carries on what each remembers.

    effects: (name, values). colours: of each effect that adds noise of its own, the spectral density (601,) per Hz of
    integral 1. expected: of each of them the expected square (n,) at the microphone of the last block. memory: samples
    of the past that restart() wants at least.
    """

    def __init__(self, effects: Sequence[tuple[str, Values]] = ()) -> None:
        applied = chain(effects)
        self._makers = [
            (
                partial(ExpectedSquare, effect, values, effect.memory or 0) if effect.noise_is_asked else None,
                stream_form(effect, values) if effect.stage == "source" else None,
            )
            for effect, values in applied
        ]
        self.colours: list[Array] = [effect.colour(values) for effect, values in applied if effect.noise_is_asked]
        self.expected: list[Samples] = []
        self._links = self._new_links()
        self.memory = LONG_MEMORY if any(run and not isinstance(run, Windowed) for _, run in self._links) else 0

    def _new_links(self) -> list[tuple[ExpectedSquare | None, Runner | None]]:
        """Of each effect the noise that it adds and what it does to the signal, as before the first sample."""
        return [(noise() if noise else None, run() if run else None) for noise, run in self._makers if noise or run]

    def __call__(self, block: Samples) -> Samples:
        """Put a block (n,) through the effects; it follows the last one."""
        if self.colours:
            self.expected = []
        for noise, run in self._links:
            if noise:
                self.expected.append(noise(block))
            if run:
                block = run(block)
        return block

    def restart(self, past: Samples) -> Samples:
        """Put another past (n,) through the effects, in place of the one that was; the next block follows it."""
        self._links = self._new_links()
        return self(past)


class VoiceChain:
    """Applies to the predicted voice, hop by hop, what acts behind the path and is no filter: the microphone, above all.

    effects: (name, values); those that are filters are in the impulse response already.
    """

    def __init__(self, effects: Sequence[tuple[str, Values]] = ()) -> None:
        behind = [pair for pair in chain(effects) if pair[0].stage in ("path", "microphone")]
        self._runners = [make() for effect, values in behind if (make := stream_form(effect, values))]

    def __bool__(self) -> bool:
        """Whether anything acts there."""
        return bool(self._runners)

    def __call__(self, voice: Samples, heard: Samples) -> Samples:
        """The voice (n,) that the path brings, as the microphone hands it on; heard (n,): all that it handed on."""
        for run in self._runners:
            voice = run(voice, heard)
        return voice
