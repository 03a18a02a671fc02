"""The robot's voices: sentences rendered with Kokoro-82M, or renderings that are there, as 16 kHz FLAC."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import soundfile as sf
import soxr

from bench.simulate.selection import Sentence
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE

SUFFIXES = (".flac", ".wav", ".ogg")
Renderer = Callable[[Sentence], tuple[np.ndarray, int]]
"""A sentence's samples (n,) and their rate."""


def kokoro(model: Path, voices: Path) -> Renderer:
    """Renders with the package kokoro-onnx, British voices (b...) in British English.

    model, voices: kokoro-v1.0.int8.onnx and voices-v1.0.bin of its release of model files. Raises UsageError without
    the package.
    """
    try:
        from kokoro_onnx import Kokoro
    except ImportError as error:
        raise UsageError(
            "rendering needs the package kokoro-onnx: pip install kokoro-onnx, or give --renderings"
        ) from error
    engine = Kokoro(str(model), str(voices))

    def render(sentence: Sentence) -> tuple[np.ndarray, int]:
        language = "en-gb" if sentence.voice.startswith("b") else "en-us"
        return engine.create(sentence.text, voice=sentence.voice, speed=1.0, lang=language)

    return render


def renderings(folder: Path) -> Renderer:
    """Takes FOLDER/VOICE/NNN.flac, .wav or .ogg, or FOLDER/SET/VOICE/...; raises UsageError for one that is missing."""

    def read(sentence: Sentence) -> tuple[np.ndarray, int]:
        places = [
            root / f"{sentence.path}{suffix}" for root in (folder, folder / sentence.folder) for suffix in SUFFIXES
        ]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            raise UsageError(
                f"{folder} holds no {sentence.path}.flac, .wav or .ogg, expected a rendering of '{sentence.text}'"
            )
        samples, rate = sf.read(found, dtype="float32", always_2d=True)
        return samples.mean(axis=1), rate

    return read


def write(sentence: Sentence, render: Renderer, folder: Path) -> tuple[str, float]:
    """Write one sentence below the folder; returns its path there and its length in seconds."""
    samples, rate = render(sentence)
    samples = np.asarray(samples, np.float32)
    if rate != SAMPLE_RATE:
        samples = soxr.resample(samples, rate, SAMPLE_RATE)
    path = folder / f"{sentence.path}.flac"
    path.parent.mkdir(parents=True, exist_ok=True)
    sf.write(path, np.clip(samples, -1.0, 1.0), SAMPLE_RATE, subtype="PCM_16")
    return f"{sentence.path}.flac", samples.size / SAMPLE_RATE
