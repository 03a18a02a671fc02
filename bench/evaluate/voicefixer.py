"""VoiceFixer (Liu et al. 2021, MIT) as the paper's post-filter, where its package and its two weight files are on this machine.

`pip install voicefixer` brings no weights: importing it downloads them to ~/.cache/voicefixer. Nothing is fetched here,
so it is imported only where they lie already.
"""

from __future__ import annotations

import importlib
import importlib.util
from functools import lru_cache
from pathlib import Path

import numpy as np
import soxr

from bench.evaluate.clips import NotHere
from edgefilter.types import SAMPLE_RATE, Samples

RATE = 44_100
FOLDER = Path(".cache") / "voicefixer"
WEIGHTS = (
    Path("analysis_module") / "checkpoints" / "vf.ckpt",
    Path("synthesis_module") / "44100" / "model.ckpt-1490000_trimed.pt",
)
"""Where the package looks for them, below FOLDER of the home folder."""


def find() -> tuple[Path, ...]:
    """Both weight files; raises NotHere where one, or the package, is missing."""
    files = tuple(Path.home() / FOLDER / path for path in WEIGHTS)
    for file in files:
        if not file.is_file():
            raise NotHere(
                f"no package carries the weights: expected {FOLDER.as_posix()}/{file.name}, in the home folder"
            )
    if importlib.util.find_spec("voicefixer") is None:
        raise NotHere("needs the package voicefixer: pip install voicefixer")
    return files


def version() -> str:
    """The weights by size, and the package's adapter."""
    return " ".join(f"{file.name} {file.stat().st_size}" for file in find()) + Path(__file__).read_text(
        encoding="utf-8"
    )


def restore(samples: Samples) -> Samples:
    """What it makes of samples (n,), as many again; it works at 44.1 kHz."""
    wide = soxr.resample(samples, SAMPLE_RATE, RATE).astype(np.float32)
    out = _network(find()).restore_inmem(wide, cuda=False, mode=0)
    narrow = soxr.resample(np.asarray(out, np.float32).reshape(-1), RATE, SAMPLE_RATE).astype(np.float32)
    return np.pad(narrow, (0, max(samples.size - narrow.size, 0)))[: samples.size]


@lru_cache(maxsize=1)
def _network(files: tuple[Path, ...]):  # noqa: ANN202
    """Loads those files by itself, once."""
    return importlib.import_module("voicefixer").VoiceFixer()
