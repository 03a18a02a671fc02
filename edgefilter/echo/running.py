"""Effects of the profile in the running filter, hop by hop: merged into the path's response, on overlapping windows, or by their own code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import cast

import numpy as np

from edgefilter.echo.effect import Effect, Runner, vanishes
from edgefilter.echo.effects.catalogue import chain
from edgefilter.echo.measurement import Values
from edgefilter.types import SAMPLE_RATE, Array, Samples

MEMORIES = (0, 64, 256, 1024)
"""Samples of the past that are tried for an effect that does not say how many it needs."""
PROBE, ROOM = 2048, 8192
"""Samples of noise on which an effect is tried, and with the silence around it."""
SHIFTS = (131, 777)
"""Samples by which a filter's input is moved to see its output move along: no rate below 2 kHz has both as periods."""
ALL_BUT_EQUAL = 1e-5
"""Difference, relative in power, up to which two outputs are the same: -50 dB are not heard in what a filter leaves."""
LONG_MEMORY = SAMPLE_RATE
"""Samples of the past from which an effect with its own way of running begins anew: two releases of a slow compressor."""


class SourceChain:
    """The reference, block by block, as the source effects of a model hand it to the path, and what no waveform predicts of it.

    effects: (name, values). colours: of each effect that adds noise of its own, the spectral density (601,) per Hz of
    integral 1. expected: of each of them the expected square (n,) at the microphone of the last block. memory: samples
    of the past that restart() wants at least.
    """

    def __init__(self, effects: Sequence[tuple[str, Values]] = ()) -> None:
        self._makers: list[Callable[[], Runner]] = []
        self.colours: list[Array] = []
        self.expected: list[Samples] = []
        for effect, values in chain(effects):
            if effect.adds_noise and not effect.followed:
                self._makers.append(partial(ExpectedSquare, effect.variance, values, effect.memory or 0))
                self.colours.append(effect.colour(values))
            if effect.stage == "source" and (make := stream_form(effect, values)):
                self._makers.append(make)
        self._links = [make() for make in self._makers]
        self.memory = 0 if all(isinstance(link, Windowed) for link in self._links) else LONG_MEMORY

    def __call__(self, block: Samples) -> Samples:
        """Put a block (n,) through the effects; it follows the last one."""
        if self.colours:
            self.expected = []
        for link in self._links:
            if isinstance(link, ExpectedSquare):
                self.expected.append(link(block))
            else:
                block = link(block)
        return block

    def restart(self, past: Samples) -> Samples:
        """Put another past (n,) through the effects, in place of the one that was; the next block follows it."""
        self._links = [make() for make in self._makers]
        return self(past)


class VoiceChain:
    """The predicted voice, hop by hop, behind what acts after the path and is no filter: the microphone, above all.

    effects: (name, values); those that are filters are in the impulse response already.
    """

    def __init__(self, effects: Sequence[tuple[str, Values]] = ()) -> None:
        behind = [pair for pair in chain(effects) if pair[0].stage in ("path", "microphone")]
        self._runners = [make() for effect, values in behind if (make := stream_form(effect, values))]

    def __bool__(self) -> bool:
        return bool(self._runners)

    def __call__(self, voice: Samples, heard: Samples) -> Samples:
        """The voice (n,) that the path brings, as the microphone hands it on; heard (n,): all that it handed on."""
        for run in self._runners:
            voice = run(voice, heard)
        return voice


class Windowed:
    """A hook of an effect, its apply or variance, on a stream: at each hop on the hop and so many samples before it."""

    def __init__(self, hook: Callable[[Samples, Values, int], Samples], values: Values, memory: int) -> None:
        self._hook, self._values = hook, values
        self._past = np.zeros(memory, np.float32)

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        """Return what the hook makes of x (n,), (n,)."""
        whole, memory = np.concatenate((self._past, x)), self._past.size
        self._past = whole[x.size :]
        return self._hook(whole, self._values, SAMPLE_RATE)[memory:]


class ExpectedSquare(Windowed):
    """What an effect that no waveform predicts adds to the expected square of each sample, on a stream: by its variance."""


def stream_form(effect: Effect, values: Values) -> Callable[[], Runner] | None:
    """What makes the effect for a stream, as before the first sample; None where it changes nothing there or is a filter."""
    if effect.stage not in ("source", "path", "microphone") or vanishes(effect, values) or is_filter(effect, values):
        return None
    if effect.run(values, SAMPLE_RATE) is not None:
        return lambda: cast(Runner, effect.run(values, SAMPLE_RATE))
    memory = _memory(effect, values)
    return None if memory is None else partial(Windowed, effect.apply, values, memory)


def reach(effect: Effect, values: Values) -> str:
    """A sentence on how the running filter treats the effect, where that differs from apply; else empty."""
    if effect.run_note or vanishes(effect, values):
        return effect.run_note
    if effect.stage == "noise" or effect.adds_noise or is_filter(effect, values) or stream_form(effect, values):
        return ""
    if effect.timed:
        return "the running filter ignores it: it happened at certain moments of this recording"
    return (
        f"the running filter ignores it: it needs more than {MEMORIES[-1]} samples of the past, or depends on"
        " when the recording began; a method run() would tell how it goes on from hop to hop"
    )


def is_filter(effect: Effect, values: Values) -> bool:
    """Whether an effect belongs to the path: of stage "path" where a trial finds it linear and always the same."""
    if effect.stage != "path":
        return effect.stage == "response"
    a, b = (_probe(seed) for seed in (0, 1))
    one, other = (effect.apply(x, values, SAMPLE_RATE) for x in (a, b))
    if not _same(effect.apply(a + 2.0 * b, values, SAMPLE_RATE), one + 2.0 * other):
        return False
    return all(_same(effect.apply(np.roll(a, shift), values, SAMPLE_RATE)[shift:], one[:-shift]) for shift in SHIFTS)


def _memory(effect: Effect, values: Values) -> int | None:
    """Samples of the past after which apply on a window is apply on all, as it says or by trial; None for more than MEMORIES."""
    if effect.memory is not None:
        return effect.memory
    return None if effect.timed else next((m for m in MEMORIES if _goes_by_windows(effect, values, m)), None)


def _goes_by_windows(effect: Effect, values: Values, memory: int) -> bool:
    x = _probe(2)
    whole = effect.apply(x, values, SAMPLE_RATE)
    starts = [ROOM // 2 + shift for shift in SHIFTS]
    return all(
        _same(effect.apply(x[start:], values, SAMPLE_RATE)[memory:], whole[start + memory :]) for start in starts
    )


def _probe(seed: int) -> Samples:
    """Noise of changing level in the middle of silence, (2 ROOM,)."""
    x = np.zeros(2 * ROOM, np.float32)
    level = 0.2 * (1.0 + np.sin(np.arange(PROBE) / 100.0))
    x[ROOM // 2 : ROOM // 2 + PROBE] = level * np.random.default_rng(seed).standard_normal(PROBE)
    return x


def _same(found: Samples, expected: Samples) -> bool:
    difference = found.astype(np.float64) - expected
    return float(difference @ difference) <= ALL_BUT_EQUAL * float(np.sum(expected.astype(np.float64) ** 2))
