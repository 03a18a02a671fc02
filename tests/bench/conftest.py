"""Speech-like clips, and two conversations simulated from them, made once for all tests of the benchmark."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from scipy import signal

from bench import provenance
from bench.recordings import Clip, Signals
from bench.simulate import conversations, simulated_robot
from bench.simulate.simulated_robot import Robot
from edgefilter.types import SAMPLE_RATE as RATE


def babble(seconds: float, seed: int) -> np.ndarray:
    """(n,) noise with the band and the syllables of speech, peak 0.5."""
    rng = np.random.default_rng(seed)
    carrier = signal.sosfilt(
        signal.butter(2, [150, 3500], "band", fs=RATE, output="sos"), rng.standard_normal(int(seconds * RATE))
    )
    syllables = np.abs(signal.sosfilt(signal.butter(2, 4.0, fs=RATE, output="sos"), rng.standard_normal(carrier.size)))
    x = carrier * syllables
    return (0.5 * x / np.abs(x).max()).astype(np.float32)


@pytest.fixture(scope="session", autouse=True)
def short_demonstrations() -> Iterator[None]:
    """The first seconds of those by which a result is stamped: every system that a test measures would hear the whole of them."""
    whole = provenance.Demo.signals

    def first_seconds(demo: provenance.Demo) -> Signals:
        return Signals(*(samples if samples is None else samples[: 2 * RATE] for samples in whole(demo)[:3]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(provenance.Demo, "signals", first_seconds)
        yield


@pytest.fixture(scope="session")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("speech")
    rows = []
    for i in range(6):
        sf.write(folder / f"{i}.flac", babble(3.2, i), RATE)
        rows.append(f"{i}.flac\ts{i % 2}\t3.20\tsome words here")
    (folder / "transcripts.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


@contextmanager
def driven() -> Iterator[None]:
    """Give simulated loudspeakers one drive, at which they distort clearly: the search for the drawn distortion takes most of the time."""

    def drive(robot: Robot, played: np.ndarray, response: np.ndarray, nl_db: float) -> tuple[Robot, float]:
        return replace(robot, loudspeaker=replace(robot.loudspeaker, drive=4.0)), nl_db

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated_robot, "with_distortion", drive)
        yield


def make(clips: Path, output: Path, kind: str, count: int) -> None:
    words = ["--speech", clips, "--voices", clips, "--output", output, "--kind", kind, "--count", count]
    with driven(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["conversations.py", *map(str, words)])
        conversations.main()


@pytest.fixture(scope="session")
def live(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made by the first of several processes that needs them; the others wait for it."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "conversations"
    with open(folder.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            make(clips, folder.with_suffix(".part") / "live", "live", 2)
            folder.with_suffix(".part").rename(folder)
    return folder / "live"


def bursts(seed: int, seconds: int) -> np.ndarray:
    """Noise that comes and goes, as a voice does."""
    rng = np.random.default_rng(seed)
    envelope = np.repeat(rng.uniform(0.2, 1.0, 4 * seconds), RATE // 4)
    return (0.05 * envelope * rng.standard_normal(seconds * RATE)).astype(np.float32)


def write_pair(folder: Path, name: str, ref: np.ndarray, mic: np.ndarray) -> None:
    sf.write(folder / f"{name}_lpb.wav", ref, RATE)
    sf.write(folder / f"{name}_mic.wav", mic, RATE)


@dataclass(frozen=True)
class Scene:
    """A source of a clip."""

    made: Signals
    name: str = "scene"

    def signals(self) -> Signals:
        return self.made


def clip_of(seconds: float, text: str | None = None) -> Clip:
    """A robot, and in the second half a human 20 dB below it."""
    robot, human = babble(seconds, 1), 0.1 * babble(seconds, 2)
    start = human.size // 2
    human[:start] = 0
    return Clip("set", "lab", Scene(Signals(robot + human, robot, human, slice(start, human.size))), "s", "p", text)


def beginning(clip: Clip, seconds: float = 4.0) -> Clip:
    """The clip with so much of its signals alone."""
    size, signals = int(seconds * RATE), clip.signals
    clip.signals = Signals(*(None if x is None else x[:size] for x in signals[:3]), signals.span)
    return clip


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    """Two recordings of one robot alone, one of each other kind; loopbacks a little shorter, as in reality."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    names = ("device1_00", "device1_01", "x_doubletalk", "x_farend_singletalk", "x_nearend_singletalk")
    for index, name in enumerate(names):
        ref = bursts(index, 7)
        echo = 0.5 * np.roll(ref, 300)
        human = bursts(10 + index, 7) if index in (2, 4) else 0.0
        write_pair(folder, name, ref[:-100] if index != 4 else 0 * ref[:-100], human + (0 if index == 4 else echo))
    return folder


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    folder = tmp_path / "speech"
    folder.mkdir()
    lines = []
    for index in range(2):
        sf.write(folder / f"{index}.wav", np.concatenate((np.zeros(RATE // 2), bursts(20 + index, 3))), RATE)
        lines.append(f"{index}.wav\t{index}\t3.50\tone two three")
    (folder / "transcripts.tsv").write_text("\n".join(lines) + "\n")
    return folder


def rows_of(found: dict) -> list[dict]:
    """The rows that results.columns made."""
    return [dict(zip(found["columns"], values, strict=True)) for values in found["values"]]
