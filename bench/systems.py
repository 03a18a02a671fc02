"""The one catalogue of systems: what each does with a clip, what it knows, and why one cannot be had here.

A row's name says how an engine runs: `crnn` with the clip's calibration, `crnn-learning` learns while it runs as well,
`crnn-uncalibrated` and `crnn-uncalibrated-learning` know nothing beforehand. `crnn-listen`, and so on, is the same
engine's sound for people. In `crnn-uncalibrated-asked` the robot lowers its voice while somebody may speak. `-true-lag`
behind a peer's name: its reference is delayed by the true lag, which no robot knows.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench import closed_loop, detectors, peers, results, voicefilter
from bench.closed_loop import Output, recorded
from bench.detectors import DETECTORS
from bench.recordings import Clip, NotHere, Signals
from edgefilter import EgoFilter, PathLearner, Profile
from edgefilter.closed_loop import ASK_DB
from edgefilter.engines import HAVE_MODEL, create
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.budget import versions
from edgefilter.filter.echo_path import FilteredHop, Learner, PathState, PathUpdate
from edgefilter.types import SAMPLE_RATE, SoundFor

OWN = ("linear", "ss", "crnn")
WAYS = {"": "calibrated", "-learning": "calibrated and learning", "-uncalibrated-learning": "learning only",
        "-uncalibrated": "uncalibrated"}  # fmt: skip
LISTEN = "-listen"
ARRAYS = (2, 3, 4)
"""Numbers of microphones, of conversations that have so many."""
TRUE_LAG = "-true-lag"
PEERS = {"speexdsp": "SpeexDSP", "speexdsp-suppressed": "SpeexDSP with its suppressor", "aec3": "WebRTC AEC3",
         "echoff": "echoff", "voiceclean": "voiceclean"}  # fmt: skip
SPECIAL = ("detector", "listen", "asked")
"""Kinds of systems that run only where they are named."""
HEARD = ("unfiltered", "speexdsp-suppressed", "aec3", "crnn-uncalibrated")
"""Rows behind which a detector of speech can stand, as "ROW+DETECTOR" or "ROW+DETECTOR-held"."""
ABSENT = {
    "paper-ss-voicefixer": ("SS after post-filtering (VoiceFixer)", "no package carries VoiceFixer's weights"),
    "dtln-aec": ("DTLN-aec", "no package carries its weights"),
    "nkf-aec": ("NKF-AEC", "no package carries its weights"),
}
"""Rows that readers will look for, and why nobody can have them."""
BATCH_NORM = "paper-crnn-narrow-batch-norm"
MODELS = voicefilter.MODEL.parent
NARROW = {"paper-crnn-narrow": ("", ""), BATCH_NORM: (", with batch normalisation", " --norm batch")}
"""Title and option of training of the paper's network with fewer filters and units: at full width that takes days."""


@dataclass(frozen=True)
class System:
    """A row.

    kind: unfiltered, paper, own, listen, asked, peer, bound or detector. knows: what it had besides microphone and reference. latency_ms: from
    its windows, None where it answers only at the end. missing: raises NotHere where it cannot run here. code: files
    and versions on which its output depends. model: a network that no engine brings.
    """

    name: str
    title: str
    kind: str
    run: Callable[[Clip], Output]
    knows: str = ""
    latency_ms: float | None = None
    missing: Callable[[], object] = lambda: None
    code: Callable[[], str] = lambda: ""
    model: Path | None = None

    @property
    def learns(self) -> bool:
        return self.name.endswith("-learning")


class Row(NamedTuple):
    """What a row's name says: "crnn-uncalibrated-learning" is engine crnn without a profile, learning."""

    engine: str
    calibrated: bool
    learning: bool
    sound: SoundFor = "recognise"


def row(name: str) -> Row:
    base = name.removesuffix("-learning")
    heard = base.removesuffix("-uncalibrated")
    engine = heard.removesuffix(LISTEN)
    return Row(engine, heard == base, base != name, "recognise" if engine == heard else "listen")


def catalogue(networks: Mapping[str, Path] | None = None) -> dict[str, System]:
    """All systems that the benchmark compares, by name, in the order of its tables. networks: ONNX files, each a further system with engine crnn."""
    rows = [System("unfiltered", "Unfiltered", "unfiltered", lambda clip: Output(clip.mic), latency_ms=0.0)]
    rows += [
        *_paper(),
        *(_own(engine, way) for way in WAYS for engine in (*OWN, f"crnn{LISTEN}")),
        _asked(),
        *_arrays(),
        *_peers(),
    ]
    rows += [_own("crnn", "", path, f"crnn:{name}") for name, path in (networks or {}).items()]
    rows += _bounds()
    rows += [
        _behind(one, name, held) for one in rows if one.name in HEARD for name in DETECTORS for held in (False, True)
    ]

    def refuse(why: str) -> object:
        raise NotHere(why)

    rows += [System(name, title, "peer", lambda clip: Output(clip.mic), missing=partial(refuse, why))
             for name, (title, why) in ABSENT.items()]  # fmt: skip
    return {one.name: one for one in rows}


def chosen(names: Sequence[str], networks: Mapping[str, Path] | None = None) -> list[System]:
    """The rows of these names; without any, all but the SPECIAL. Raises UsageError for a name that no row has."""
    rows = catalogue(networks)
    for name in names:
        if name not in rows:
            raise UsageError(f"unknown system '{name}': choose some of {', '.join(rows)}")
    return [one for one in rows.values() if one.name in names or (not names and one.kind not in SPECIAL)]


def present(rows: Iterable[System]) -> tuple[list[System], dict[str, str]]:
    """The rows that can run here, and of the others name and reason."""
    here, reasons = [], {}
    for one in rows:
        try:
            one.missing()
            here.append(one)
        except EdgefilterError as error:
            reasons[one.title] = str(error).replace(f"{results.ROOT}/", "")
    return here, reasons


def run_engine(
    wanted: Row, signals: Signals, profile: Profile | None, learner: Learner | None = None, model: Path | None = None
) -> Output:
    """An engine over mic and ref, hop by hop as live, so that its events and the probability after each hop are known."""
    more = {"model": model, "learn": learner, "output": wanted.sound}
    return closed_loop.listen(signals.mic, signals.ref, profile, wanted.engine, **more)


def _own(engine: str, way: str, model: Path | None = None, name: str = "", title: str = "", train: str = "") -> System:
    """A row of an engine of the package. title: of a row of the source paper. train: what makes a model that is missing."""
    wanted = row(engine + way)
    kind = "paper" if title else "own" if wanted.sound == "recognise" else "listen"
    must = wanted.calibrated and (model is None or kind == "paper")

    def run(clip: Clip) -> Output:
        profile = clip.profile if wanted.calibrated else None
        if must and profile is None:
            raise NotHere("no calibration of this device")
        learner = _updates(clip.fingerprint, profile) if wanted.learning else None
        return run_engine(wanted, clip.signals, profile, learner, model)

    def missing() -> object:
        if model and not model.is_file():
            raise NotHere(f"no {model.name} in {model.parent.name}/" + (f": train one with {train}" if train else ""))
        return create(wanted.engine, model=model) if wanted.engine in HAVE_MODEL else None

    knows = WAYS[way] if wanted.learning else "calibration" if wanted.calibrated else "neither"
    title = title or (f"{engine} with network {name.partition(':')[2]}" if model else f"{engine}, {WAYS[way]}")
    late = None if engine == "paper-crnn" else _latency_ms(wanted.engine)  # whole clips
    code = partial(_engine_code, wanted.engine, model)
    return System(name or engine + way, title, kind, run, knows, late, missing, code, model)


def _asked() -> System:
    """The row of `crnn` without a calibration, on a real robot that lowers its voice where the filter asks for it."""

    def run(clip: Clip) -> Output:
        if clip.human is None and clip.talk != "farend":
            raise NotHere("the robot alone is not known here")
        robot = recorded(clip.mic if clip.human is None else clip.mic - clip.human, clip.ref, ASK_DB)
        return closed_loop.listen(clip.mic, clip.ref, None, "crnn", robot)

    title = "crnn, uncalibrated, asks the robot to lower its voice"
    return System(
        "crnn-uncalibrated-asked",
        title,
        "asked",
        run,
        "neither",
        _latency_ms("crnn"),
        code=partial(_engine_code, "crnn"),
    )


def _arrays() -> list[System]:
    """Rows of `crnn` with several microphones: streamed, and the finished turns."""
    found, late, code = [], _latency_ms("crnn"), partial(_engine_code, "crnn")
    for count, way in product(ARRAYS, ("", "-learning")):
        told, knows = f"crnn, {count} microphones, {WAYS[way]}", WAYS[way] if way else "calibration"
        for kind, title, latency_ms in (("", told, late), ("-turns", f"{told}, finished turns", None)):
            run = partial(_of_array, count, bool(way), bool(kind))
            found.append(System(f"crnn-{count}{kind}{way}", title, "own", run, knows, latency_ms, code=code))
    return found


_streamed: dict[tuple[str, int, bool], tuple[Output, float]] = {}
"""The latest outputs of arrays, and the seconds that each took: a conversation's turns, and the rows of both kinds, share them."""


def _of_array(count: int, learning: bool, turns: bool, clip: Clip) -> Output:
    """What `crnn` makes of the first count microphones; turns: with the finished turns in place of what was streamed."""
    signals, profile = clip.array(count)
    key = clip.fingerprint, count, learning
    if key in _streamed:
        clip.lent_s += _streamed[key][1]
    else:
        if len(_streamed) == 2 * len(ARRAYS):
            _streamed.pop(next(iter(_streamed)))
        began, learner = time.perf_counter(), PathLearner(profile) if learning else None
        output = run_engine(Row("crnn", True, learning), signals, profile, learner)
        _streamed[key] = output, time.perf_counter() - began
    found = _streamed[key][0]
    if not turns:
        return found
    samples = found.samples.copy()
    for turn in (event.turn for event in found.events or () if event.turn):
        samples[turn.start : turn.start + turn.samples.size] = turn.samples
    return found._replace(samples=samples)


def _engine_code(engine: str, model: Path | None = None) -> str:
    """Digest of the package and of the engine's network."""
    path = create(engine, model=model).model.path if engine in HAVE_MODEL else None
    return results.code_digest() + (hashlib.sha256(Path(path).read_bytes()).hexdigest() if path else "")


@cache
def _latency_ms(engine: str) -> float | None:
    try:
        return 1000 * EgoFilter(engine=engine).latency / SAMPLE_RATE
    except EdgefilterError:
        return None


class _Kept:
    """Learns a recording once and says it again to the next engine, since no update depends on the engine."""

    def __init__(self, profile: Profile | None) -> None:
        self._learner: Learner | None = PathLearner(profile)
        self._updates: dict[int, PathUpdate] = {}
        self._at = 0

    def start(self, path: PathState, hop: int) -> None:
        if self._at:
            self._learner, self._at = None, 0
        if self._learner:
            self._learner.start(path, hop)

    def observe(self, hop: FilteredHop) -> PathUpdate | None:
        self._at += 1
        if self._learner and (update := self._learner.observe(hop)):
            self._updates[self._at] = update
        return self._updates.get(self._at)

    def stats(self) -> dict[str, object]:
        return {}

    def close(self) -> None: ...


_latest: dict[tuple[str, bool], _Kept] = {}


def _updates(recording: str, profile: Profile | None) -> _Kept:
    """The learner that has taken this recording before, or a new one; at most four are kept."""
    key = (recording, profile is not None)
    if key not in _latest:
        if len(_latest) == 4:
            _latest.pop(next(iter(_latest)))
        _latest[key] = _Kept(profile)
    return _latest[key]


def _paper() -> list[System]:
    rows = [_voicefilter(), _own("paper-ss", "", title="SS before post-filtering"),
            _own("paper-crnn", "", title="CRNN of the paper's shape")]  # fmt: skip
    for name, (differs, option) in NARROW.items():
        title = f"CRNN of the paper's shape, narrower (1.8 of 34 M parameters){differs}"
        train = f"python -m export.train --network paper --filters 16 2 --lstm 80 --hidden 150{option}"
        rows.append(_own("paper-crnn", "", MODELS / f"{name.replace('-', '_')}_int8.onnx", name, title, train))
    return rows


def _voicefilter() -> System:
    def run(clip: Clip) -> Output:
        return Output(voicefilter.keep(clip.mic, clip.voice()))

    title = "VoiceFilter, small, told the human's voice"
    model = voicefilter.MODEL if voicefilter.MODEL.is_file() else None

    def code() -> str:
        return _files(voicefilter, model) + str(versions([voicefilter.ENCODER]))

    return System("voicefilter", title, "paper", run, "the human's voice", None, voicefilter.find, code, model)


def _files(module: object, model: Path | None = None) -> str:
    """Digest of a module's own code and of a network."""
    paths = [Path(str(module.__file__)), *([model] if model else [])]  # type: ignore[attr-defined]
    return results.code_digest(paths)


def _peers() -> list[System]:
    late = (peers.FRAME, peers.FRAME + peers.SUPPRESSED_DELAY, peers.AEC3_FRAME + peers.AEC3_DELAY,
            peers.AEC3_FRAME + peers.ECHOFF_DELAY, peers.VOICECLEAN_FRAME)  # fmt: skip
    found = []
    for (name, title), samples in zip(PEERS.items(), late, strict=True):
        process = getattr(peers, name.replace("-", "_"))
        tried = partial(process, *np.zeros((2, SAMPLE_RATE // 10), np.float32))
        probe = peers.echoff_processor if name == "echoff" else tried
        for ending, told in (("", ""), (TRUE_LAG, ", told the true lag")):

            def run(clip: Clip, process: Callable = process, lagged: bool = bool(ending)) -> Output:
                return Output(process(clip.mic, clip.delayed_reference() if lagged else clip.ref))

            knows, ms = ("the true lag" if ending else "neither"), 1000 * samples / SAMPLE_RATE
            found.append(System(name + ending, title + told, "peer", run, knows, ms, probe, partial(_files, peers)))
    return found


def _behind(base: System, name: str, held: bool) -> System:
    """A detector of speech that hears what another row makes, as late as that comes."""
    detector = DETECTORS[name]
    late = round((base.latency_ms or 0.0) * SAMPLE_RATE / 1000)

    def run(clip: Clip) -> Output:
        out = clip.once(base.name, lambda: base.run(clip).samples)
        found = detectors.probabilities(detector, out)
        return Output(out, list(detectors.events(detector, found, held, late)), found, detector.hop)

    def missing() -> object:
        return base.missing(), detector.start()

    def code() -> str:
        return base.code() + _files(detectors) + str(versions([detector.package]))

    title = f"{detector.title}{f' held {detectors.HELD_S:g} s' if held else ''} behind {base.title}"
    return System(f"{base.name}+{name}{'-held' * held}", title, "detector", run, base.knows, None, missing, code)


def _bounds() -> list[System]:
    return [
        System("clean", "The human alone", "bound", lambda clip: Output(clip.known_human())),
        System("fan-kept", "Echo gone, fan kept", "bound", lambda clip: Output(clip.known_human() + clip.fan())),
    ]
