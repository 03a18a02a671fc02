"""Speech-like clips, and two conversations simulated from them, made once for all tests of the benchmark."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from scipy import signal

from bench.simulate import conversations

RATE = 16000


def babble(seconds: float, seed: int) -> np.ndarray:
    """(n,) noise with the band and the syllables of speech, peak 0.5."""
    rng = np.random.default_rng(seed)
    carrier = signal.sosfilt(
        signal.butter(2, [150, 3500], "band", fs=RATE, output="sos"), rng.standard_normal(int(seconds * RATE))
    )
    syllables = np.abs(signal.sosfilt(signal.butter(2, 4.0, fs=RATE, output="sos"), rng.standard_normal(carrier.size)))
    x = carrier * syllables
    return (0.5 * x / np.abs(x).max()).astype(np.float32)


@pytest.fixture(scope="session")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("speech")
    rows = []
    for i in range(6):
        sf.write(folder / f"{i}.flac", babble(3.2, i), RATE)
        rows.append(f"{i}.flac\ts{i % 2}\t3.20\tsome words here")
    (folder / "transcripts.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


def make(clips: Path, output: Path, kind: str, count: int) -> None:
    arguments = [
        "conversations.py",
        "--speech",
        clips,
        "--voices",
        clips,
        "--output",
        output,
        "--kind",
        kind,
        "--count",
        count,
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(argument) for argument in arguments])
        conversations.main()


@pytest.fixture(scope="session")
def live(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("made") / "live"
    make(clips, output, "live", 2)
    return output
