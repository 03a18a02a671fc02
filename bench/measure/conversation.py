"""A robot conversation of bench/simulate/conversations.py as the measuring programs read it."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import soundfile as sf
from tqdm import tqdm

from edgefilter.calibration.calibrate import calibrate
from edgefilter.errors import UsageError
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

MARGIN = 32
"""Samples by which a true lag is given too short, so that a canceller's causal filter holds the direct sound's rise."""
Item = TypeVar("Item")


@dataclass(frozen=True)
class Conversation:
    """A folder of the generator; signals are read when asked for."""

    folder: Path

    @cached_property
    def meta(self) -> dict:
        return json.loads((self.folder / "meta.json").read_text(encoding="utf-8"))

    @cached_property
    def fingerprint(self) -> str:
        names = ("mic", "ref", "clean", "sweep_mic", "fan_only")
        return hashlib.sha256(b"".join((self.folder / f"{name}.flac").read_bytes() for name in names)).hexdigest()

    def read(self, name: str) -> Samples:
        samples, rate = sf.read(self.folder / f"{name}.flac", dtype="float32")
        if rate != SAMPLE_RATE:
            remedy = "make it anew with bench.simulate.conversations"
            raise UsageError(f"{self.folder / name}.flac has {rate} Hz, expected {SAMPLE_RATE}: {remedy}")
        return samples

    @cached_property
    def profile(self) -> Profile:
        return calibrate(self.read("sweep_ref"), self.read("sweep_mic"), self.read("fan_only"))

    @property
    def span(self) -> slice:
        return slice(self.meta["start"], self.meta["end"])

    def delayed_reference(self) -> Samples:
        """The reference with each utterance delayed by its true lag and the converters' delay, less MARGIN, (n,)."""
        ref, at, meta = self.read("ref"), self.meta["t_main"], self.meta
        delay = direct_delay(self.read("sweep_ref"), self.read("sweep_mic")) - MARGIN
        out = np.zeros_like(ref)
        for samples, start, lag in ((ref[:at], 0, meta["lag"]), (ref[at:], at, meta.get("lag2", meta["lag"]))):
            begin = max(start + lag + delay, 0)
            kept = samples[: max(ref.size - begin, 0)]
            out[begin : begin + kept.size] += kept
        return out


def direct_delay(sweep_ref: Samples, sweep_mic: Samples) -> int:
    """Samples by which the direct sound of the sweep arrives later than played (peak of the whitened correlation)."""
    size = 1 << (2 * sweep_ref.size).bit_length()
    played = np.fft.rfft(sweep_ref, size)
    power = np.abs(played) ** 2
    response = np.fft.irfft(np.fft.rfft(sweep_mic, size) * played.conj() / (power + 1e-3 * power.max()))
    return int(np.argmax(np.abs(response[:SAMPLE_RATE])))


def find_conversations(folders: list[Path]) -> dict[str, list[Conversation]]:
    """Conversations by the name of their set; raises UsageError for a folder without any."""
    sets: dict[str, list[Conversation]] = {}
    for folder in folders:
        found = [Conversation(path.parent) for path in sorted(folder.glob("*/meta.json"))]
        if not found:
            raise UsageError(
                f"{folder} holds no */meta.json, expected conversations: make some with bench.simulate.conversations"
            )
        sets[folder.resolve().name if folder.resolve().name not in sets else str(folder)] = found
    return sets


def every(sets: dict[str, list[Conversation]], n: int = 1) -> list[tuple[str, Conversation]]:
    """Set and conversation, every n-th of each set."""
    return [(name, conversation) for name, found in sets.items() for conversation in found[::n]]


def progress(
    items: Sequence[Item], unit: str = "recording", name: str | None = None
) -> Iterator[Item] | Iterable[Item]:
    """The items, with a bar where somebody is looking."""
    return tqdm(items, unit=unit, desc=name, disable=not sys.stderr.isatty())
