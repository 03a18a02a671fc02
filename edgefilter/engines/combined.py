"""Engines made of engines: several that take turns with a crossfade, and one whose speech another one judges."""

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
"""The engine whose network says for others whether a human speaks."""


@dataclass(frozen=True, slots=True)
class Voice:
    """One engine at work: its index, its state, and its answers that wait where another engine looks further ahead."""

    rung: int
    state: EngineState
    waiting: tuple[Output, ...]


@dataclass(frozen=True, slots=True)
class LadderState:
    """The engine whose output is heard, the one that fades in (if any), the frames until it can, and its weight, 0 to 1."""

    heard: Voice
    coming: Voice | None = None
    filling: int = 0
    weight: float = 0.0


class Ladder:
    """An engine that runs one of its rungs; set `wanted` and it crossfades there, frame by frame.

    rungs: best first, all with the same STFT and front, so that alignment and linear stage run on untouched; their
    look-aheads may differ, all answers come out as late as the latest. A request during a crossfade turns it back, or
    is met after it. Raises UsageError without rungs, or where they differ in STFT or front.
    """

    name: ClassVar[str] = "ladder"

    def __init__(self, rungs: Sequence[Engine]) -> None:
        if not rungs:
            raise UsageError("no engine to run: name at least one")
        for rung in rungs[1:]:
            if not _take_turns(rung, rungs[0]):
                raise UsageError(
                    f"engines {rungs[0].name} and {rung.name} cannot take turns: their STFTs or fronts differ"
                )
        self.rungs = tuple(rungs)
        self.stft = rungs[0].stft
        self.front: FrontEndKind = rungs[0].front
        self.lookahead = max(rung.lookahead for rung in rungs)
        self.wanted = 0

    def initial_state(self) -> LadderState:
        return LadderState(self._start(self.wanted))

    def step(self, frame: Frame, state: LadderState) -> tuple[Output, LadderState]:
        if state.coming is None and self.wanted != state.heard.rung:
            state = LadderState(state.heard, self._start(self.wanted), self.lookahead)
        output, heard = self._run(state.heard, frame)
        if state.coming is None:
            return output, LadderState(heard)
        other, coming = self._run(state.coming, frame)
        weight = state.weight if state.filling else self._move(state.weight, state.heard.rung, state.coming.rung)
        if weight == 0.0 and self.wanted == heard.rung:
            return output, LadderState(heard)
        if weight == 1.0:
            return other, LadderState(coming)
        spectrum = output.spectrum + np.float32(weight) * (other.spectrum - output.spectrum)
        louder = output if weight < 0.5 else other
        return Output(spectrum, louder.speech_probability), LadderState(
            heard, coming, max(state.filling - 1, 0), weight
        )

    def _move(self, weight: float, *rungs: int) -> float:
        """The next weight of the voice that is coming in (rungs: heard, coming), towards whichever of the two is nearer to what is wanted."""
        goal = 1 if abs(self.wanted - rungs[1]) < abs(self.wanted - rungs[0]) else 0
        step = 1.0 / (DOWN if rungs[goal] == max(rungs) else UP)
        return min(weight + step, 1.0) if goal else max(weight - step, 0.0)

    def _start(self, rung: int) -> Voice:
        engine = self.rungs[rung]
        silence = Output(np.zeros(self.stft.bins, np.complex64))
        return Voice(rung, engine.initial_state(), (silence,) * (self.lookahead - engine.lookahead))

    def _run(self, voice: Voice, frame: Frame) -> tuple[Output, Voice]:
        output, state = self.rungs[voice.rung].step(frame, voice.state)
        first, *rest = (*voice.waiting, output)
        return first, Voice(voice.rung, state, tuple(rest))


def climbable(best: Engine, profile: Profile | None) -> list[Engine]:
    """The best candidate and the cheaper ones that can take turns with it: those that can be made with its STFT and front."""
    rungs, names = [best], engines.CANDIDATES
    for name in names[names.index(best.name) + 1 :] if best.name in names else ():
        try:
            engine = cast(Engine, engines.create(name, profile, best.stft))  # no candidate needs the whole recording
        except EdgefilterError:
            continue
        if _take_turns(engine, best):
            rungs.append(engine)
    return rungs


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
        return Output(output.spectrum, judged.speech_probability), (own, other)


def with_network_as_judge(engine: Engine | ClipEngine, profile: Profile | None = None) -> Engine | ClipEngine:
    """The engine with the judgement of crnn's network; raises UsageError without a linear stage, ModelError without a network."""
    if engine.name == JUDGE:
        return engine
    return cast(Engine, Judged(cast(Engine, engine), cast(Engine, engines.create(JUDGE, profile))))


def judges_speech(engine: Engine | ClipEngine) -> bool:
    """Whether the engine says how probable it is that a human speaks."""
    return engine.name == JUDGE or isinstance(engine, Judged)
