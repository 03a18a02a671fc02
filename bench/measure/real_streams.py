"""What is listened to: pairs of loopback and microphone as recorded, and humans laid on those without one."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import soundfile

from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, Samples

LENGTHS_S = 1.0
"""Seconds by which a loopback may differ from its microphone: recorders of real devices stop one after the other."""
KINDS = ("doubletalk", "farend", "nearend")
ECHO_ONLY = "echo-only"
ROBOT_ALONE = "device1_*"
"""Names of the public recordings that hold the robot alone."""
UTTERANCE_S = (3.0, 10.0)
"""Length of the humans' utterances: some words, and over before the recording is."""
TAIL_S = 0.5
"""Robot after the human's end, so that no system is judged on its flushing."""
AUDIO = (".wav", ".flac", ".ogg")
_TRIES = 50
"""Places drawn for a human before the one with the most robot is taken."""
_ROBOT_SILENT = 0.25
"""No place is taken where the robot has less than this share of its mean power: the SER would mean nothing."""


class Signals(NamedTuple):
    """mic, ref (n,) float32; human (n,) as it is inside mic and its span, where it was laid on."""

    mic: Samples
    ref: Samples
    human: Samples | None = None
    span: slice = slice(None)


@dataclass(frozen=True)
class Recording:
    """A pair of files: what the loudspeaker was sent and what the microphone heard. kind: ECHO_ONLY or one of KINDS."""

    name: str
    kind: str
    ref_path: Path
    mic_path: Path

    def signals(self) -> Signals:
        mic, ref = read(self.mic_path), read(self.ref_path)
        if not mic.size or abs(mic.size - ref.size) > LENGTHS_S * SAMPLE_RATE:
            found = f"{mic.size / SAMPLE_RATE:.2f} s of microphone and {ref.size / SAMPLE_RATE:.2f} s of loopback"
            raise UsageError(
                f"{self.name}: {found}, expected within {LENGTHS_S:.0f} s as much: take the files of one recording"
            )
        return Signals(mic, np.pad(ref, (0, max(mic.size - ref.size, 0)))[: mic.size])


@dataclass(frozen=True)
class Laid:
    """A human laid on a recording without one.

    at: sample of the recording at which the human begins. before: seconds of robot that are heard first. ser: power of
    the human over that of the microphone's recording while the human speaks, dB. noise, noise_at, noise_db: a fan's
    file, its first sample, and its power against the mean power of the recording, dB.
    """

    case: int
    recording: Recording
    at: int
    speech: Path
    text: str
    ser: float
    before: float
    noise: Path | None = None
    noise_at: int = 0
    noise_db: float = 0.0

    @property
    def name(self) -> str:
        return f"case {self.case} on {self.recording.name}"

    def signals(self) -> Signals:
        echo, ref, _, _ = _echo(self.recording)
        human = read(self.speech).astype(np.float64)
        begin, end = self.at - round(self.before * SAMPLE_RATE), self.at + human.size + round(TAIL_S * SAMPLE_RATE)
        mic, span = echo[begin:end].astype(np.float64), slice(self.at - begin, self.at - begin + human.size)
        laid = np.zeros_like(mic)
        laid[span] = human * np.sqrt(np.mean(mic[span] ** 2) / np.mean(human**2)) * 10 ** (self.ser / 20)
        mic += laid
        if self.noise:
            fan = looped(read(self.noise), self.noise_at, mic.size)
            mic += fan * np.sqrt(np.mean(echo.astype(np.float64) ** 2) / np.mean(fan**2)) * 10 ** (self.noise_db / 20)
        full = max(
            1.0, float(np.abs(mic).max())
        )  # a converter's range holds all of it: turned down together where it would not
        return Signals((mic / full).astype(np.float32), ref[begin:end], (laid / full).astype(np.float32), span)


@lru_cache(maxsize=4)
def _echo(recording: Recording) -> Signals:
    return recording.signals()


def read(path: Path) -> Samples:
    """Samples (n,) of a file; raises UsageError for another rate or more channels."""
    samples, rate = soundfile.read(path, dtype="float32")
    if rate != SAMPLE_RATE or samples.ndim != 1:
        channels = 1 if samples.ndim == 1 else samples.shape[1]
        raise UsageError(f"{path}: {rate} Hz, {channels} channels, expected {SAMPLE_RATE} Hz mono: convert it first")
    return samples


def looped(x: Samples, at: int, n: int) -> Samples:
    """N samples of x from `at` on, forwards and backwards in turn, so that no join is heard."""
    there_and_back = np.concatenate((x, x[::-1]))
    return there_and_back[(at + np.arange(n)) % there_and_back.size].astype(np.float64)


def find_recordings(folder: Path, echo_only: str) -> list[Recording]:
    """All pairs of a folder, *_lpb.* and *_mic.*, by name; echo_only matches those without a human.

    Raises UsageError for a folder without any, a file without its partner, and a name of no kind.
    """
    files = {
        path.stem: path
        for path in sorted(folder.glob("*"))
        if path.suffix in AUDIO and path.stem.endswith(("_lpb", "_mic"))
    }
    names = sorted({stem[:-4] for stem in files})
    if not names:
        raise UsageError(
            f"{folder} holds no *_lpb and *_mic files ({', '.join(AUDIO)}), expected pairs of loopback and microphone"
        )
    for name in names:
        for ending in ("_lpb", "_mic"):
            if name + ending not in files:
                raise UsageError(
                    f"{folder} holds {name} without its {ending} file, expected both: add it or remove the other"
                )
    return [Recording(name, kind(name, echo_only), files[f"{name}_lpb"], files[f"{name}_mic"]) for name in names]


def kind(name: str, echo_only: str) -> str:
    if fnmatch(name, echo_only):
        return ECHO_ONLY
    found = [word for word in KINDS if word in name]
    if not found:
        raise UsageError(
            f"{name}: expected {', '.join(KINDS)} in its name, or a match of {echo_only}: give --echo-only"
        )
    return found[0]


def chosen(recordings: list[Recording], split: str, pattern: str) -> list[Recording]:
    """All with a human, and those without that are asked for: first half by name to tune on, second to report."""
    alone = [recording for recording in recordings if recording.kind == ECHO_ONLY]
    half = (len(alone) + 1) // 2
    kept = {"tune": alone[:half], "report": alone[half:], "all": alone}[split]
    return [
        recording
        for recording in recordings
        if recording.kind != ECHO_ONLY or recording in kept and fnmatch(recording.name, pattern)
    ]


@dataclass(frozen=True)
class Cells:
    """Every case is laid on at every SER (dB), after every time of robot alone (s), without and with a fan."""

    sers: tuple[float, ...] = (0.0, -10.0, -20.0, -26.0)
    befores: tuple[float, ...] = (0.0, 5.0, 20.0)
    noise_db: float = -30.0


def lay(
    recordings: list[Recording], speech: Path, noise: Path | None, cells: Cells, cases: int, seed: int
) -> list[Laid]:
    """Cases humans on the recordings in turn; case i of a seed has the same human, place and fan in all cells."""
    utterances, fans = transcripts(speech), _fans(noise)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(utterances))
    laid = []
    for case in range(cases):
        recording, (path, text) = recordings[case % len(recordings)], utterances[order[case % order.size]]
        at = place(recording, soundfile.info(path).frames, max(cells.befores), rng)
        fan = fans[rng.integers(len(fans))] if fans else None
        fan_at = int(rng.integers(1 << 20))
        for noise_file in (None, fan) if fan else (None,):
            for before in cells.befores:
                laid += [
                    Laid(case, recording, at, path, text, ser, before, noise_file, fan_at, cells.noise_db)
                    for ser in cells.sers
                ]
    return laid


def place(recording: Recording, human: int, before: float, rng: np.random.Generator) -> int:
    """Where a human of so many samples begins: enough robot before it, and the robot not silent meanwhile."""
    power = np.cumsum(np.append(0.0, _echo(recording).mic.astype(np.float64) ** 2))
    low, high = round(before * SAMPLE_RATE), power.size - 1 - human - round(TAIL_S * SAMPLE_RATE)
    if high < low:
        needed = before + human / SAMPLE_RATE + TAIL_S
        raise UsageError(
            f"{recording.name}: {(power.size - 1) / SAMPLE_RATE:.1f} s, expected {needed:.1f} s for this human"
        )
    draws = rng.integers(low, high + 1, size=_TRIES)
    robot = (power[draws + human] - power[draws]) / human
    good = np.flatnonzero(robot > _ROBOT_SILENT * power[-1] / (power.size - 1))
    return int(draws[good[0] if good.size else np.argmax(robot)])


def transcripts(folder: Path) -> list[tuple[Path, str]]:
    """Utterances of a length in UTTERANCE_S with their texts, from transcripts.tsv (path, speaker, seconds, text)."""
    table = folder / "transcripts.tsv"
    if not table.is_file():
        raise UsageError(
            f"{folder} holds no transcripts.tsv (path, speaker, seconds, text), expected humans: see bench/README.md"
        )
    with table.open(encoding="utf-8", newline="") as lines:
        rows = [
            row for row in csv.reader(lines, delimiter="\t", quoting=csv.QUOTE_NONE) if len(row) == 4 and row[3].strip()
        ]
    low, high = UTTERANCE_S
    found = [(folder / path, text) for path, _, seconds, text in rows if low <= float(seconds) <= high]
    if not found:
        raise UsageError(
            f"{table} names no utterance of {low:.0f} to {high:.0f} s with a text, expected some: give another folder"
        )
    return found


def _fans(folder: Path | None) -> list[Path]:
    if folder is None:
        return []
    found = sorted(path for path in folder.rglob("*") if path.suffix in AUDIO)
    if not found:
        raise UsageError(f"{folder} holds no noise ({', '.join(AUDIO)}), expected recordings of fans")
    return found
