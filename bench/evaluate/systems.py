"""The rows of the evaluation: what each does with a clip, whether it had a calibration, and why one cannot be had."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

import edgefilter
from bench.evaluate import denoisers, spectra, voicefilter, voicefixer
from bench.evaluate.clips import Heard, NotHere
from bench.measure import peers, quality
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines import create
from edgefilter.engines.paper_ss import PAPER_STFT, L
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE, Samples

CALIBRATED, LEARNING, NEITHER = "calibration", "learning only", "neither"
WHERE_THERE_IS = "calibration if any"
TRUE_LAG = "the true lag"
VOICE = "the human's voice"
NONE = ""
BATCH_NORM = "batch-norm"
"""The name under which --network takes a network with batch normalisation, for the third of the paper's conclusions."""
NARROW_BATCH_NORM = "paper-crnn-narrow-batch-norm"
"""The twin of paper-crnn-narrow that was trained with batch normalisation."""
NARROW_CRNN = Path(__file__).parents[1] / "models" / "paper_crnn_narrow_int8.onnx"
NARROW_CRNN_NORMED = NARROW_CRNN.with_name("paper_crnn_narrow_batch_norm_int8.onnx")
"""The checkout's own; the package does not bring it."""


@dataclass(frozen=True)
class System:
    """A row.

    kind: unfiltered, paper, own, peer, denoiser or bound. knows: what it had besides microphone and reference.
    latency_ms: from its windows, None where it answers only at the end. missing: raises NotHere where it cannot run here.
    model: the file of a network that no engine brings.
    """

    name: str
    title: str
    kind: str
    run: Callable[[Heard], Samples]
    knows: str = NONE
    latency_ms: float | None = None
    missing: Callable[[], object] = lambda: None
    code: Callable[[], str] = lambda: ""
    model: Path | None = None

    @property
    def learns(self) -> bool:
        return self.knows == LEARNING


def absent(why: str) -> Callable[[], object]:
    """A row that nobody can have, and why."""

    def missing() -> object:
        raise NotHere(why)

    return missing


def catalogue(networks: Mapping[str, Path] | None = None) -> dict[str, System]:
    """All rows by name, in the order of the tables. networks: further networks for the engine crnn, by name."""
    rows = [_base("unfiltered", "Unfiltered", "unfiltered", latency_ms=0.0), *_paper(), *_own(), *_peers()]
    rows += [_network(name, path) for name, path in (networks or {}).items()]
    rows += [*_denoisers(), *_bounds()]
    return {row.name: row for row in rows}


def chosen(names: Sequence[str], networks: Mapping[str, Path] | None = None) -> list[System]:
    """The rows of these names, all without any. Raises UsageError for a name that no row has."""
    rows = catalogue(networks)
    for name in names:
        if name not in rows:
            raise UsageError(f"unknown system '{name}': choose some of {', '.join(rows)}")
    return [row for row in rows.values() if not names or row.name in names]


def present(rows: Sequence[System]) -> tuple[list[System], dict[str, str]]:
    """The rows that can run here, and of the others name and reason."""
    here, reasons = [], {}
    for row in rows:
        try:
            row.missing()
        except EdgefilterError as error:
            reasons[row.title] = str(error)
        else:
            here.append(row)
    return here, reasons


def _base(name: str, title: str, kind: str, **rest: object) -> System:
    """A row of bench.measure.quality."""
    base = name.removesuffix(quality.TRUE_LAG)

    def run(heard: Heard) -> Samples:
        source = heard.source
        ref = source.delayed_reference() if base != name else source.read("ref")
        return quality.processor(base)(source, ref)

    return System(name, title, kind, run, code=lambda: quality.code_version(base), **rest)  # type: ignore[arg-type]


def _own() -> list[System]:
    rows = []
    ways = {
        CALIBRATED: ("", "calibrated"),
        LEARNING: ("-uncalibrated-learning", "learning only"),
        NEITHER: ("-uncalibrated", "uncalibrated"),
    }
    for knows, (ending, words) in ways.items():
        for engine in ("linear", "ss", "crnn"):
            row = _base(engine + ending, f"{engine}, {words}", "own", knows=knows, latency_ms=_latency_ms(engine))
            rows.append(_calibrated(row) if knows == CALIBRATED else row)
    return rows


def _calibrated(row: System) -> System:
    """The row, for clips that have a calibration only, made before its time counts."""

    def run(heard: Heard) -> Samples:
        if heard.source.profile is None:
            raise NotHere("no calibration of this device")
        return row.run(heard)

    return System(**{**row.__dict__, "run": run})


@cache
def _latency_ms(engine: str) -> float | None:
    try:
        found = edgefilter.EgoFilter(engine=engine).latency
    except EdgefilterError:
        return None
    return 1000 * found / SAMPLE_RATE


def _network(name: str, path: Path) -> System:
    def run(heard: Heard) -> Samples:
        source = heard.source
        return edgefilter.enhance(heard.mic, source.read("ref"), source.profile, "crnn", model=path)

    def code() -> str:
        return quality.code_version("crnn") + hashlib.sha256(path.read_bytes()).hexdigest()

    def missing() -> object:
        return create("crnn", model=path)

    title = f"crnn with network {name}"
    return System(f"crnn:{name}", title, "own", run, WHERE_THERE_IS, _latency_ms("crnn"), missing, code, path)


def _paper() -> list[System]:
    lite = "VoiceFilter-Lite, told the human's voice"

    def filtered(heard: Heard) -> Samples:
        voice = heard.clip.voice()
        return denoisers.voicefilter_lite(heard.mic, voice)

    late = 1000 * (PAPER_STFT.window_length + L * PAPER_STFT.hop) / SAMPLE_RATE
    paper_ss = _calibrated(_base("paper-ss", "SS before post-filtering", "paper", knows=CALIBRATED, latency_ms=late))
    repaired = "SS after post-filtering (VoiceFixer)"

    def post(heard: Heard) -> Samples:
        return voicefixer.restore(paper_ss.run(heard))

    crnn = _calibrated(_base("paper-crnn", "CRNN of the paper's shape", "paper", knows=CALIBRATED))
    return [
        _voicefilter(),
        _bundled("voicefilter-lite", lite, "paper", filtered),
        paper_ss,
        System("paper-ss-voicefixer", repaired, "paper", post, CALIBRATED, None, voicefixer.find, voicefixer.version),
        System(**{**crnn.__dict__, "missing": lambda: create("paper-crnn"), "code": _paper_crnn}),
        _calibrated(_narrow_crnn("paper-crnn-narrow", NARROW_CRNN)),
        _calibrated(_narrow_crnn(NARROW_BATCH_NORM, NARROW_CRNN_NORMED, ", with batch normalisation", " --norm batch")),
    ]


def _voicefilter() -> System:
    """The paper's baseline: a small network of this project's training, since no package carries the weights."""

    def run(heard: Heard) -> Samples:
        return voicefilter.keep(heard.mic, heard.clip.voice())

    title = "VoiceFilter (the paper's baseline), small, trained here"
    find, version = voicefilter.find, voicefilter.version
    return System("voicefilter", title, "paper", run, VOICE, missing=find, code=version, model=voicefilter.MODEL)


def _paper_crnn(model: Path | None = None) -> str:
    """Hash of code and network; model: None for the engine's own."""
    path = create("paper-crnn", model=model).model.path  # type: ignore[union-attr]
    return quality.code_version("paper-crnn") + hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _narrow_crnn(name: str, model: Path, differs: str = "", trained: str = "") -> System:
    """The paper's network with fewer filters and units, of this project's training: at full width that takes days.

    differs: for the title. trained: further options of its training.
    """

    def run(heard: Heard) -> Samples:
        source = heard.source
        return edgefilter.enhance(heard.mic, source.read("ref"), source.profile, "paper-crnn", model=model)

    def missing() -> object:
        if not model.is_file():
            command = f"python -m export.train --network paper --filters 16 2 --lstm 80 --hidden 150{trained}"
            raise NotHere(f"no {model.name} in {model.parent.name}/: train one with {command}")
        return create("paper-crnn", model=model)

    title = f"CRNN of the paper's shape, narrower (1.8 of 34 M parameters){differs}"
    return System(name, title, "paper", run, CALIBRATED, missing=missing, code=lambda: _paper_crnn(model), model=model)


def _peers() -> list[System]:
    frame_ms = 1000 * peers.FRAME / SAMPLE_RATE
    aec3_ms = 1000 * (peers.AEC3_FRAME + peers.AEC3_DELAY) / SAMPLE_RATE
    rows = {
        "speexdsp": ("SpeexDSP", frame_ms),
        "speexdsp-suppressed": ("SpeexDSP with its suppressor", 2 * frame_ms),
        "aec3": ("WebRTC AEC3", aec3_ms),
    }
    found = []
    for name, (title, late) in rows.items():
        probe = partial(getattr(peers, name.replace("-", "_")), *np.zeros((2, SAMPLE_RATE // 10), np.float32))
        found.append(_base(name, title, "peer", knows=NEITHER, latency_ms=late, missing=probe))
        lagged, told = f"{name}{quality.TRUE_LAG}", f"{title}, told the true lag"
        found.append(_base(lagged, told, "peer", knows=TRUE_LAG, latency_ms=late, missing=probe))
    for title, why in {
        "DTLN-aec": "no package carries its weights; DTLN against noise is below",
        "NKF-AEC": "no package carries its weights",
    }.items():
        found.append(System(title.lower(), title, "peer", lambda heard: heard.mic, missing=absent(why)))
    return found


def linear(heard: Heard) -> Samples:
    """What our linear stage leaves, (n,), with a calibration where there is one; computed once for a clip."""
    source = heard.source
    return heard.once(
        "linear", lambda: edgefilter.enhance(heard.mic, source.read("ref"), source.profile, engine="linear")
    )


def _denoisers() -> list[System]:
    titles = {"dtln": "DTLN", "rnnoise": "RNNoise", "gtcrn": "GTCRN", "deepfilternet3": "DeepFilterNet3"}

    def behind(network: Callable[[Samples], Samples], heard: Heard) -> Samples:
        return network(linear(heard))

    return [
        _bundled(name, f"linear, then {title}", "denoiser", partial(behind, getattr(denoisers, name)))
        for name, title in titles.items()
    ]


def _bundled(name: str, title: str, kind: str, run: Callable[[Heard], Samples]) -> System:
    """A network from a package: behind our linear stage, or told a voice."""
    late = denoisers.LATENCIES_MS[name] + (_latency_ms("linear") or 0.0 if kind == "denoiser" else 0.0)
    knows = WHERE_THERE_IS if kind == "denoiser" else VOICE

    def code() -> str:
        own = quality.code_version("linear") if kind == "denoiser" else ""
        return own + denoisers.version(name) + Path(denoisers.__file__).read_text(encoding="utf-8")

    return System(name, title, kind, run, knows, late, lambda: denoisers.bundled(name), code)


def _bounds() -> list[System]:
    def code() -> str:
        own = [Path(__file__), Path(spectra.__file__)]
        return quality.code_version("linear") + "".join(path.read_text(encoding="utf-8") for path in own)

    return [
        _base("clean", "The human alone", "bound"),
        System("fan-kept", "Echo gone, fan kept", "bound", lambda heard: heard.human + heard.fan(), code=code),
        System("ideal-mask", "Ideal mask on what linear leaves", "bound", ideal_mask, WHERE_THERE_IS, code=code),
    ]


def ideal_mask(heard: Heard) -> Samples:
    """What the linear stage leaves, each bin at the human's magnitude where that is less, (n,)."""
    config = StftConfig()
    error, human = (spectra.analysed(config, x) for x in (linear(heard), heard.human))
    gain = np.minimum(np.abs(human) / np.maximum(np.abs(error), 1e-9), 1.0)
    return spectra.synthesised(config, gain * error, heard.mic.size)
