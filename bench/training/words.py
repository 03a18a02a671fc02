"""Which network keeps the words: networks against 'ss' on validation conversations, by what a recogniser makes of them.

Loss and SI-SDR did not predict word errors, so networks are chosen by these. Every network answers alone, and mixed
with the Wiener mask of 'ss', with the linear stage's error, and with both (--wiener, --error: shares of the answer),
beside the package's own `linear`, `ss` and `crnn`. Differences are paired: each utterance against its own answer by
'ss'. All systems get the very same frames: the front end (alignment, echo cancellation, noise estimate) runs once.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench import provenance, recordings, results, runner
from bench.cache import Cache
from bench.metrics import SECOND, CachedMetrics, difference, mean, middle, pooled
from bench.recordings import Cells, Clip, RobotSilent, progress
from edgefilter import PathLearner
from edgefilter.dsp.metrics import si_sdr
from edgefilter.dsp.stft import StftConfig, Synthesiser
from edgefilter.engines import create
from edgefilter.engines.base import Engine, EngineState, FrontEndKind
from edgefilter.engines.crnn import Crnn
from edgefilter.engines.linear import Linear
from edgefilter.engines.spectral_subtraction import SpectralSubtraction
from edgefilter.errors import UsageError
from edgefilter.filter.stream import Stream, step
from edgefilter.profile.data import Profile
from edgefilter.types import Frame, Output, Samples

REAL = Cells(sers=(-10.0, -20.0), befores=(0.0, 10.0))
"""Of humans laid on real loudspeakers."""
BASE = "ss"
COLD, SILENT, LAID = " cold", " robot silent", "real loudspeaker"
"""How the kind of a conversation without its profile ends, and of one without its robot; the kind of humans laid on real loudspeakers."""


class Case(NamedTuple):
    """A clip, with its profile or without. kind: whose table it stands in."""

    kind: str
    clip: Clip
    profile: Profile | None


class Contender(NamedTuple):
    """An engine, made of the filter's profile; identity: of the code and the network on which its answer depends."""

    make: Callable[[Profile | None], Engine]
    identity: str


@dataclass(frozen=True)
class Mixed:
    """An engine with a share of another's answer in its own: what one deletes the other may have kept."""

    engine: Engine
    other: Engine
    share: float
    name: str = "mixed"
    front: FrontEndKind = "full"

    @property
    def stft(self) -> StftConfig:
        return self.engine.stft

    @property
    def lookahead(self) -> int:
        return self.engine.lookahead

    def initial_state(self) -> EngineState:
        return self.engine.initial_state(), self.other.initial_state()

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        (ours, mine), (theirs, its) = self.engine.step(frame, state[0]), self.other.step(frame, state[1])
        recognise, listen = (1 - self.share) * ours.sounds + self.share * theirs.sounds
        return Output(listen.astype(np.complex64), ours.speech_probability, recognise.astype(np.complex64)), (mine, its)


@dataclass(frozen=True)
class Listener:
    """In place of an engine: stores the frames that it is given."""

    stft: StftConfig
    frames: list[Frame]
    name: str = "listener"
    front: FrontEndKind = "full"
    lookahead: int = 0

    def initial_state(self) -> EngineState:
        return ()

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        self.frames.append(Frame(*(part.copy() for part in frame[:6]), *frame[6:]))
        return Output(frame.error), state


def frames(case: Case, stft: StftConfig, learning: bool) -> list[Frame]:
    """What every engine of that transform is given."""
    listener = Listener(stft, [])
    stream = Stream(listener, case.profile, learner=PathLearner(case.profile) if learning else None)
    stream.process(case.clip.mic, case.clip.ref)
    stream.flush()
    return listener.frames


def answer(engine: Engine, given: list[Frame], samples: int) -> Samples:
    """The sound for a recogniser that the engine makes of these frames, (samples,)."""
    state, voice, hops = engine.initial_state(), Synthesiser(engine.stft), []
    for frame in given:
        output, state = step(engine, frame, state)
        hops.append(voice.push(output.sounds[0]))
    return np.concatenate(hops)[engine.stft.window_length - engine.stft.hop :][:samples]


def contenders(networks: Sequence[Path], wiener: Sequence[float], error: Sequence[float]) -> dict[str, Contender]:
    """What is compared, by name: linear, ss and crnn as they ship, and each network, alone and mixed."""
    code = results.code_digest()
    found = {"linear": Contender(partial(create, "linear"), code)}
    for name in (BASE, "crnn"):
        shipped = "".join(results.digest(path)["sha256"] for path in provenance.models_of([name]).values())
        found |= _with_error(name, Contender(partial(create, name), code + shipped), error)
    for model in networks:
        name = f"{model.parent.name}/{model.stem}"
        identity = code + results.digest(model)["sha256"]
        found |= _with_error(name, Contender(lambda _, model=model: Crnn(model), identity), error)
        for share in wiener:
            mixed = Contender(lambda _, m=model, s=share: mix(Crnn(m), SpectralSubtraction, s), identity)
            found |= _with_error(f"{name}, {share:g} {BASE}", mixed, error)
    return found


def _with_error(name: str, one: Contender, shares: Sequence[float]) -> dict[str, Contender]:
    """An engine as it is, and with each share of the linear stage's error."""
    found = {name: one}
    for share in shares:
        mixed = Contender(lambda profile, s=share: mix(one.make(profile), Linear, s), one.identity)
        found[f"{name}, {share:g} error"] = mixed
    return found


def mix(engine: Engine, other: Callable[[StftConfig], Engine], share: float) -> Mixed:
    """An engine with a share of another's answer, at its own transform."""
    return Mixed(engine, other(engine.stft), share)


def compare(
    case: Case, making: dict[str, Contender], learning: bool, cached: CachedMetrics, kept: Cache
) -> Iterator[dict]:
    given: dict[StftConfig, list[Frame]] = {}
    clip = case.clip

    def made(contender: Contender) -> dict:
        engine = contender.make(case.profile)
        if engine.stft not in given:
            given[engine.stft] = frames(case, engine.stft, learning)
        out = answer(engine, given[engine.stft], clip.mic.size)[clip.span]
        return {"si_sdr": si_sdr(out, clip.known_human()[clip.span])} | cached.words(clip.text or "", out)

    about = {"kind": case.kind, "clip": f"{case.kind} {clip.name}", "speaker": clip.speaker, "place": clip.place}
    for name, contender in making.items():
        key = ("words", clip.fingerprint, case.profile is None, learning, name, contender.identity, cached.asked)
        yield {**about, "system": name, **kept.get(lambda contender=contender: made(contender), *key)}


def cases(options: argparse.Namespace) -> list[Case]:
    found = []
    sets = recordings.find_conversations(options.conversations)
    for name, clip in recordings.every(sets, options.every, options.limit):
        found.append(Case(f"{name} {clip.room}", clip, clip.profile))
        found += [Case(f"{name} {clip.room}{COLD}", clip, None)] * options.cold
        if options.silent:
            found.append(Case(f"{name} {clip.room}{SILENT}", replace(clip, source=RobotSilent(clip)), clip.profile))
    if options.alone:
        laid = recordings.lay(options.alone, options.speech, REAL, options.cases, options.seed)
        clips = recordings.named(recordings.laid_clips(laid, options.speech, LAID), "real")
        found += [Case(LAID, clip, None) for clip in clips[:: options.every][: options.limit]]
    return found


def tables(rows: Sequence[dict]) -> list[dict]:
    """A table per kind, one of the conversations with their profile, one of those without, one without the robot, and one of all."""
    kinds = {kind: [row for row in rows if row["kind"] == kind] for kind in dict.fromkeys(row["kind"] for row in rows)}
    cold = [kind for kind in kinds if kind.endswith(COLD)]
    silent = [kind for kind in kinds if kind.endswith(SILENT)]
    warm = [kind for kind in kinds if kind not in (*cold, *silent, LAID)]
    groups = {"with a calibration": warm, "without": cold, "robot silent": silent, "all": list(kinds)}
    together = {name: [row for kind in of for row in kinds[kind]] for name, of in groups.items() if len(of) > 1}
    judges = {"": ""} | ({SECOND: "second: "} if any(f"{SECOND}capped" in row for row in rows) else {})
    heads = (("WER, %", 0), ("left out", 0), ("put in", 0), ("WER less that of ss, points", 1))
    judged = ((told + head, digits) for told in judges.values() for head, digits in heads)
    columns = ["system", *judged, ("SI-SDR, dB", 1)]
    found = []
    for kind, own in (kinds | together).items():
        cells = []
        for system in dict.fromkeys(row["system"] for row in own):
            mine, base = ([row for row in own if row["system"] == name] for name in (system, BASE))
            cells.append([system])
            for judge in judges:
                shares = [middle(pooled(mine, judge + key, f"{judge}words")) for key in ("deletions", "insertions")]
                less = difference(mine, base, f"{judge}capped") if system != BASE else None
                cells[-1] += [mean(mine, f"{judge}capped"), *shares, less]
            cells[-1].append(mean(mine, "si_sdr"))
        title = f"{kind}: {len({row['clip'] for row in own})} utterances"
        found.append(results.table(f"words-{kind}".replace(" ", "-"), title, columns, cells))
    return found


def run(options: argparse.Namespace) -> str:
    if not options.whisper:
        raise UsageError("words need a recogniser: give --whisper")
    networks = {f"{path.parent.name}/{path.name}": path for path in options.networks}
    data = {"conversations": options.conversations}
    data |= {"RECORDINGS": [options.real], "HUMAN": [options.speech]} if options.real else {}
    models = {"WHISPER": options.whisper, "SECOND": options.second_whisper, **networks}
    made_with = provenance.stamp(data, ["linear", BASE, "crnn"], models)
    making = contenders(options.networks, options.wiener, options.error)
    setup = runner.Setup(options.cache, options.whisper, second_whisper=options.second_whisper)
    cached, kept = runner.cached_metrics(setup), Cache(options.cache, "rows")
    rows: list[dict] = []
    for case in progress(cases(options), "utterance"):
        rows += compare(case, making, options.learning, cached, kept)
    notes = "Word errors at most 100 % an utterance; intervals over speakers and rooms."
    slim = [
        {
            key: value
            for key, value in row.items()
            if key not in ("transcript", f"{SECOND}transcript", "place", "speaker")
        }
        for row in rows
    ]
    return results.write(options.output, "words", "Words on validation", made_with, tables(rows), notes=notes,
                         rows=results.columns(slim))  # fmt: skip
