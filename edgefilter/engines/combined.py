"""Engines made of engines: one that switches between several with a crossfade, one whose speech probability another engine gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np

from edgefilter import engines
from edgefilter.engines.base import ClipEngine, Engine, EngineState, FrontEndKind
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.profile.data import Profile
from edgefilter.types import Frame, Output

DOWN, UP = 4, 32
"""Frames of a crossfade to a cheaper engine (64 ms, since it has to bring relief), and to a better one (0.5 s, since an
engine with a memory starts empty and has to settle while it is still quiet)."""
JUDGE = "crnn"
"""The engine whose network says whether a human speaks where the running engine cannot say it."""


@dataclass(frozen=True, slots=True)
class Voice:
    """One engine at work: its index, its state, and its answers that wait where another engine looks further ahead."""

    index: int
    state: EngineState
    waiting: tuple[Output, ...]


@dataclass(frozen=True, slots=True)
class FallbackState:
    """The engine whose output is heard, the one that fades in (if any), the frames until it can, and its weight, 0 to 1."""

    heard: Voice
    coming: Voice | None = None
    filling: int = 0
    weight: float = 0.0


class Fallback:
    """An engine that runs one of several; set `wanted`, an index, and it crossfades there, frame by frame.

    ranked: best first, all with the same STFT and front, so that alignment and linear stage run on untouched; their
    look-aheads may differ, all answers come out as late as the latest. A request during a crossfade turns it back, or
    is met after it. Raises UsageError without any, or where they differ in STFT or front.
    """

    name: ClassVar[str] = "fallback"

    def __init__(self, ranked: Sequence[Engine]) -> None:
        if not ranked:
            raise UsageError("no engine to run: name at least one")
        for other in ranked[1:]:
            if not _take_turns(other, ranked[0]):
                raise UsageError(
                    f"engines {ranked[0].name} and {other.name} cannot take turns: their STFTs or fronts differ"
                )
        self.engines = tuple(ranked)
        self.stft = ranked[0].stft
        self.front: FrontEndKind = ranked[0].front
        self.lookahead = max(one.lookahead for one in ranked)
        self.wanted = 0

    def initial_state(self) -> FallbackState:
        return FallbackState(self._start(self.wanted))

    def step(self, frame: Frame, state: FallbackState) -> tuple[Output, FallbackState]:
        if state.coming is None and self.wanted != state.heard.index:
            state = FallbackState(state.heard, self._start(self.wanted), self.lookahead)
        output, heard = self._run(state.heard, frame)
        if state.coming is None:
            return output, FallbackState(heard)
        other, coming = self._run(state.coming, frame)
        weight = state.weight if state.filling else self._move(state.weight, state.heard.index, state.coming.index)
        if weight == 0.0 and self.wanted == heard.index:
            return output, FallbackState(heard)
        if weight == 1.0:
            return other, FallbackState(coming)
        recognise, listen = output.sounds + np.float32(weight) * (other.sounds - output.sounds)
        louder = output if weight < 0.5 else other
        crossed = Output(listen, louder.speech_probability, recognise)
        return crossed, FallbackState(heard, coming, max(state.filling - 1, 0), weight)

    def _move(self, weight: float, *indices: int) -> float:
        """The next weight of the engine that fades in, nearer to the one of the two whose index is closer to `wanted`.

        indices: of the engine that is heard, and of the one that fades in.
        """
        goal = 1 if abs(self.wanted - indices[1]) < abs(self.wanted - indices[0]) else 0
        step = 1.0 / (DOWN if indices[goal] == max(indices) else UP)
        return min(weight + step, 1.0) if goal else max(weight - step, 0.0)

    def _start(self, index: int) -> Voice:
        engine = self.engines[index]
        silence = Output(np.zeros(self.stft.bins, np.complex64))
        return Voice(index, engine.initial_state(), (silence,) * (self.lookahead - engine.lookahead))

    def _run(self, voice: Voice, frame: Frame) -> tuple[Output, Voice]:
        output, state = self.engines[voice.index].step(frame, voice.state)
        first, *rest = (*voice.waiting, output)
        return first, Voice(voice.index, state, tuple(rest))


def fallbacks(best: Engine, profile: Profile | None) -> list[Engine]:
    """The best candidate and the cheaper ones that can replace it on a slow machine: those with the same STFT and front end."""
    found, names = [best], engines.CANDIDATES
    for name in names[names.index(best.name) + 1 :] if best.name in names else ():
        try:
            engine = cast(Engine, engines.create(name, profile, best.stft))  # a streaming one, as all candidates are
        except EdgefilterError:
            continue
        if _take_turns(engine, best):
            found.append(engine)
    return found


def _take_turns(one: Engine, other: Engine) -> bool:
    return (one.stft, one.front) == (other.stft, other.front)


class Judged:
    """Answer and name of `engine` with the probability of speech of `judge`; raises UsageError where their frames differ."""

    def __init__(self, engine: Engine, judge: Engine) -> None:
        for what in ("stft", "front", "lookahead"):
            own, other = getattr(engine, what), getattr(judge, what)
            if own != other:
                raise UsageError(
                    f"engine {judge.name} cannot judge speech for {engine.name}: its {what} is {other}, expected {own}"
                )
        self.name = engine.name
        self.stft = engine.stft
        self.front: FrontEndKind = engine.front
        self.lookahead = engine.lookahead
        self.model = getattr(judge, "model", None)
        self._engine, self._judge = engine, judge

    def initial_state(self) -> EngineState:
        return self._engine.initial_state(), self._judge.initial_state()

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        output, own = self._engine.step(frame, state[0])
        judged, other = self._judge.step(frame, state[1])
        return output._replace(speech_probability=judged.speech_probability), (own, other)


def with_network_as_judge(engine: Engine | ClipEngine, profile: Profile | None = None) -> Engine | ClipEngine:
    """The engine with the judgement of crnn's network; raises UsageError without a linear stage, ModelError without a network."""
    if engine.name == JUDGE:
        return engine
    return cast(Engine, Judged(cast(Engine, engine), cast(Engine, engines.create(JUDGE, profile))))


def judges_speech(engine: Engine | ClipEngine) -> bool:
    """Whether the engine says how probable it is that a human speaks."""
    return engine.name == JUDGE or isinstance(engine, Judged)
