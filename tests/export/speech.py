"""Small folders of speech-like sound for the tests of the training side."""

from pathlib import Path

import numpy as np
import soundfile as sf
from scipy import signal

RATE = 16000


def babble(rng: np.random.Generator, seconds: float) -> np.ndarray:
    """Noise with a speech-like spectrum and syllables, (n,) float32."""
    n = int(seconds * RATE)
    noise = signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))
    syllables = np.repeat(rng.uniform(0, 1, n // 1600 + 1) > 0.3, 1600)[:n]
    return (0.1 * noise * syllables / np.abs(noise).max()).astype(np.float32)


def write_librispeech(folder: Path, speakers: tuple[str, ...], seconds: float = 3.0) -> Path:
    """Two utterances of each speaker in LibriSpeech's layout."""
    rng = np.random.default_rng(len(speakers))
    for speaker in speakers:
        chapter = folder / speaker / "7"
        chapter.mkdir(parents=True)
        for number in range(2):
            sf.write(chapter / f"{speaker}-7-{number:04d}.flac", babble(rng, seconds), RATE)
    return folder


def write_table(folder: Path, speakers: tuple[str, ...]) -> Path:
    """The same speech with a transcripts.tsv instead."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(7)
    rows = []
    for speaker in speakers:
        sf.write(folder / f"{speaker}.wav", babble(rng, 4.0), RATE)
        rows.append(f"{speaker}.wav\t{speaker}\t4.0\tsome words\n")
    (folder / "transcripts.tsv").write_text("".join(rows), encoding="utf-8")
    return folder
