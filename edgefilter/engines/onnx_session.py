"""Opens the model files of the neural engines: the only place that imports onnxruntime."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.onnx_graph import refusal
from edgefilter.errors import ModelError, StftError, printable
from edgefilter.types import SAMPLE_RATE

try:
    import onnxruntime
except Exception as error:  # a broken installation raises what its binary part does: ImportError, OSError
    if isinstance(error.__cause__, KeyboardInterrupt):
        raise error.__cause__ from None
    said = " ".join(f"{type(error).__name__}: {error}".split())[:160]
    raise ModelError(f"onnxruntime cannot be loaded ({said}): pip install --force-reinstall onnxruntime") from None

_PACKAGE = Path(__file__).parent.parent
FOLDERS = (_PACKAGE / "models", _PACKAGE.parent / "models")
"""Where models lie: inside the installed package, or at the top of a checkout."""
SHIPPED = {
    "crnn.onnx": "558e33f5e5df808df886e0929ed94e42a32e5267cbd11f93e1f98298e86e318e",
    "crnn_int8.onnx": "c79a6a4531d9a5acbdf3444ae973c605bb88966ef676a374861b8c5b4c3c3922",
}
"""sha256 of the files in models/, as MODELS.md lists them."""
MOST_BYTES, MOST_STATE, MOST_FFT = 512 * 2**20, 1 << 22, 1 << 14
"""Bounds on what a file may ask for: its own size, the values in one state tensor (16 MiB), the longest transform (1 s)."""
TOLD = 160
"""Characters of what a library says that are told: the first line of it."""


@dataclass(frozen=True, eq=False)
class Model:
    """A model file that was found to fit. training and figures are what it says about itself."""

    path: Path
    sha256: str
    session: onnxruntime.InferenceSession
    stft: StftConfig
    training: Mapping[str, object]
    figures: Mapping[str, object]
    states: tuple[tuple[str, tuple[int, ...]], ...]

    @property
    def shipped(self) -> bool:
        """Whether it is, bit by bit, one of the files that edgefilter was tested with."""
        return self.sha256 in SHIPPED.values()

    def describe(self) -> dict[str, object]:
        """Ready for JSON."""
        return {"file": str(self.path), "training": dict(self.training), "figures": dict(self.figures)}


def find_model(given: str | Path | None, variable: str, name: str, remedy: str) -> Path:
    """The model file to use: the given one, else the environment variable's, else the package's own.

    Raises ModelError where there is none, or where the package's own is not the one that edgefilter was tested with.
    """
    chosen = given or os.environ.get(variable)
    if chosen:
        path = Path(chosen)
        if not path.is_file():
            origin = "" if given else f", which {variable} names,"
            raise ModelError(f"model {path}{origin} is no file: {remedy}")
        return path
    for folder in FOLDERS:
        path = folder / name
        if path.is_file():
            if name in SHIPPED and hashlib.sha256(_read(path)).hexdigest() != SHIPPED[name]:
                raise ModelError(
                    f"model {path} is not the one that belongs to this edgefilter (its sha256 is another): reinstall"
                    " edgefilter, or name a model of your own with --model"
                )
            return path
    raise ModelError(f"there is no {name} in {FOLDERS[0]}: {remedy}, or name one with --model or {variable}")


def open_session(path: Path, content: bytes | None = None) -> onnxruntime.InferenceSession:
    """A session on one core: frames are too small to share, and a second thread that spins costs a whole core.

    content: of the file, where it was read before. How the calling thread computes with denormal numbers stays as it is: to
    have them count as zero, which onnxruntime can do for the first session alone and then for good, makes no hop shorter.
    Raises ModelError for what is no ONNX model, and before anything opens it for functions, loops and branches, operators of
    other libraries and weights in other files.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    content = _read(path) if content is None else content
    # its own format, which would be taken for this one, is not read beforehand
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        if wrong := refusal(content):
            raise ModelError(f"model {path} {wrong}: export it again")
        # a fallback would print, and try the same again
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"], enable_fallback=0)
        for slot in (*session.get_inputs(), *session.get_outputs()):
            _ = slot.name, slot.shape  # text that is none fails here rather than later
        _ = session.get_modelmeta().custom_metadata_map
        return session
    except ModelError:
        raise
    except Exception as error:  # onnxruntime's exceptions share no base of their own
        raise ModelError(f"model {path} cannot be loaded ({printable(error, TOLD)}): export it again") from None


def open_model(path: Path, kind: str, version: int) -> Model:
    """Open a model and refuse it where its metadata is not that of a `kind` of this version at the package's sampling rate."""
    content = _read(path)
    session = open_session(path, content)
    said = session.get_modelmeta().custom_metadata_map
    for key, wanted in (("type", kind), ("version", str(version)), ("sample_rate", str(SAMPLE_RATE))):
        if (found := said.get(key)) != wanted:
            raise ModelError(
                f"model {path} has {key} {printable(found or 'unknown', 40)}, expected {wanted}: take the model that belongs"
                " to this engine and version"
            )
    try:
        n_fft, hop, window_length = (int(said[name]) for name in ("n_fft", "hop", "window_length"))
        if max(n_fft, hop) > MOST_FFT:
            raise ValueError(f"n_fft is {n_fft} and hop {hop}, expected at most {MOST_FFT}")
        stft = StftConfig(n_fft, hop, window_length, said["window"])
        states = tuple(
            (str(name), tuple(int(size) for size in shape)) for name, shape in json.loads(said.get("states", "[]"))
        )
        for name, shape in states:
            if min(shape, default=0) < 1 or math.prod(shape) > MOST_STATE:
                raise ValueError(f"state {name[:40]} of shape {str(shape)[:80]}")
        training, figures = json.loads(said["training"]), json.loads(said["figures"])
    except KeyError as error:
        raise ModelError(f"model {path} does not say its {error.args[0]}: export it again") from None
    except (ValueError, TypeError, StftError, RecursionError, OverflowError) as error:
        raise ModelError(f"model {path} has unusable metadata ({printable(error, TOLD)}): export it again") from None
    return Model(path, hashlib.sha256(content).hexdigest(), session, stft, training, figures, states)


def expect_slots(model: Model, inputs: Mapping[str, tuple], outputs: Mapping[str, tuple]) -> None:
    """Refuse a model with other names of inputs or outputs than these, or with incompatible shapes; "any" stands for every size."""
    for word, slots, wanted in (
        ("inputs", model.session.get_inputs(), inputs),
        ("outputs", model.session.get_outputs(), outputs),
    ):
        found = {slot.name: slot.shape for slot in slots}
        fits = found.keys() == wanted.keys() and all(_may_be(shape, wanted[name]) for name, shape in found.items())
        if not fits:
            said, expected = (
                printable(", ".join(f"{name} {list(shape)}" for name, shape in sorted(each.items())), 400)
                for each in (found, wanted)
            )
            raise ModelError(f"model {model.path} has {word} {said}, its metadata wants {expected}: export it again")


def expect_answer(path: Path, answer: Callable[[], Iterable[np.ndarray]]) -> None:
    """Refuse a model that fails on a first frame, or answers it with what is no finite number."""
    try:
        found = answer()
    except Exception as error:  # onnxruntime's own, or numpy's of shapes that cannot be
        raise ModelError(f"model {path} cannot be run ({printable(error, TOLD)}): export it again") from None
    if not all(np.isfinite(part).all() for part in found):
        raise ModelError(f"model {path} answers with values that are not finite: train it again")


def _read(path: Path) -> bytes:
    """The bytes of a model file; raises ModelError where it cannot be read, or is larger than any model."""
    try:
        if (size := path.stat().st_size) > MOST_BYTES:
            raise ModelError(f"model {path} is {size} bytes long, expected at most {MOST_BYTES}: export it again")
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"model {path} cannot be read ({error.strerror}): check the path") from None


def _may_be(found: Sequence[int | str | None], wanted: Sequence[int | str]) -> bool:
    """Whether a graph's shape, in which what is not a number is free, can be the wanted one."""
    return len(found) == len(wanted) and all(
        not isinstance(size, int) or size == want for size, want in zip(found, wanted)
    )
