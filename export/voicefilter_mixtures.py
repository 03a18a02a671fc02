"""What VoiceFilter is trained on: the microphone of simulated conversations, and the d-vector of another recording of the human."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, Array, Samples
from export.corpus import Corpus, read_speech

MOST = 5
"""Recordings of a speaker that get a d-vector."""
LONGEST_S = 8.0
"""Seconds of a recording that its d-vector is made from."""
MOVED = 0.5
"""Share of crops whose human is heard over the robot of another conversation, at the level of the one that was there."""
LOUD_REST = 0.01
"""Part of the microphone's power that the human is taken to have at least when crops are brought to one level."""
TARGET_RMS = 0.1
"""At which the human is scaled for the loss."""


class Voices:
    """D-vectors of the recordings of each speaker who has several.

    encode: from samples (n,) to a d-vector (values,). speakers: whose are needed. cache: a .npz file, read where it is
    there and written where it is not complete.
    """

    def __init__(
        self, corpus: Corpus, encode: Callable[[Samples], Array], speakers: Sequence[str], cache: Path | None = None
    ) -> None:
        found = dict(np.load(cache)) if cache and cache.is_file() else {}
        several = {name: corpus.speakers.get(name, ()) for name in sorted(set(speakers))}
        paths = {name: sorted(each)[:MOST] for name, each in several.items() if len(each) > 1}
        keys = {path: f"{name} {path.name}" for name, each in paths.items() for path in each}
        missing = [path for path, key in keys.items() if key not in found]
        for path in tqdm(missing, desc="d-vectors", unit="recording", leave=False):
            found[keys[path]] = encode(read_speech(path)[: int(LONGEST_S * SAMPLE_RATE)])
        if cache and missing:
            np.savez(cache, **found)
        self._of = {name: {path.name: found[keys[path]] for path in each} for name, each in paths.items()}

    def others(self, speaker: str | None, recordings: Sequence[str]) -> list[Array]:
        """D-vectors of that speaker's recordings that are none of these, in the order of their names; often empty."""
        known = self._of.get(speaker, {}) if speaker else {}
        return [vector for name, vector in known.items() if name not in recordings]


@dataclass(frozen=True, eq=False)
class Item:
    """Microphone and human, (n,) int16 at a scale; who speaks in which recordings, nobody where speaker is None."""

    name: str
    mic: Array
    clean: Array
    scale: float
    speaker: str | None
    recordings: tuple[str, ...]


def read_items(folder: Path) -> list[Item]:
    """The items of export/dataset.py below a folder, by name.

    Raises UsageError where there are none, or where they do not say who speaks.
    """
    items = []
    for path in tqdm(sorted(folder.glob("*.npz")), desc=f"read {folder}", unit="item", leave=False):
        with np.load(path) as file:
            about = json.loads(str(file["about"]))
            if "speaker" not in about:
                remedy = "simulate it again with python -m export.dataset"
                raise UsageError(f"{path} does not say who speaks, expected 'speaker' in its 'about': {remedy}")
            names = tuple(about["recordings"])
            scale = float(file["scale"]) / 32767
            items.append(Item(path.name, file["mic"], file["clean"], scale, about["speaker"], names))
    if not items:
        raise UsageError(f"{folder} holds no simulated items: make them with python -m export.dataset")
    return items


class Mixtures:
    """Batches from items; that of a step depends on seed, step and the items alone. names: of the items."""

    def __init__(self, items: Sequence[Item], voices: Voices, stft: StftConfig, seed: int) -> None:
        self.items, self.voices, self.stft, self.seed = items, voices, stft, seed
        self.names = [item.name for item in items]
        self.told = [item for item in items if voices.others(item.speaker, item.recordings)]
        if not self.told:
            raise UsageError(
                f"of {len(items)} items none has a human with another recording: name all folders of speech that they"
                " were made from with --speech"
            )
        self._window = torch.from_numpy(stft.analysis_window.copy())

    def draw(self, step: int, batch: int, seconds: float) -> dict[str, Tensor]:
        """The next crops, `batch` of them: see spectra()."""
        rng = np.random.default_rng([self.seed, step])
        samples = int(seconds * SAMPLE_RATE) // self.stft.hop * self.stft.hop
        rows = [self._crop(rng, samples) for _ in range(batch)]
        return self.spectra(*(np.stack(each) for each in zip(*rows, strict=True)))

    def refresh(self) -> int:
        """Number of items; it does not change after they were read."""
        return len(self.items)

    def whole(self, item: Item, seconds: float, teller: Item | None = None) -> dict[str, Tensor]:
        """The last seconds of an item, as they are, with the first d-vector that can be had of its human, or of teller's."""
        samples = min(int(seconds * SAMPLE_RATE), item.mic.size) // self.stft.hop * self.stft.hop
        cut = slice(item.mic.size - samples, None)
        told = teller or item
        voice = self.voices.others(told.speaker, told.recordings)[0]
        return self.spectra(item.scale * item.mic[None, cut], item.scale * item.clean[None, cut], voice[None])

    def somebody_else(self, item: Item) -> Item:
        """The next item whose human is another one; the same item where there is none."""
        at = self.told.index(item)
        others = [other for other in self.told[at:] + self.told[:at] if other.speaker != item.speaker]
        return others[0] if others else item

    def _crop(self, rng: np.random.Generator, samples: int) -> tuple[Samples, Samples, Array]:
        """Microphone and human (samples,), and a d-vector."""
        item = self.told[int(rng.integers(len(self.told)))]
        others = self.voices.others(item.speaker, item.recordings)
        voice = others[int(rng.integers(len(others)))]
        mic, clean = _cut(rng, item, samples)
        rest = mic - clean
        if rng.random() < MOVED:
            other_mic, other_clean = _cut(rng, self.items[int(rng.integers(len(self.items)))], samples)
            other = other_mic - other_clean
            rest = other * (_rms(rest) / max(_rms(other), 1e-6))
        return clean + rest, clean, voice

    def spectra(self, mic: Samples, clean: Samples, voice: Array) -> dict[str, Tensor]:
        """Spectra "mic", "clean" (batch, frames, bins, 2), scaled so that the human is near 1, and "d_vector" (batch, values).

        mic, clean: (batch, n). voice: (batch, values).
        """
        batch = {}
        for name, samples in (("mic", mic), ("clean", clean)):
            waves = torch.from_numpy(np.ascontiguousarray(samples, np.float32))
            frames = waves.unfold(1, self.stft.window_length, self.stft.hop) * self._window
            batch[name] = torch.view_as_real(torch.fft.rfft(frames, self.stft.n_fft))
        power = {name: spectrum.square().sum((2, 3)) for name, spectrum in batch.items()}
        loud = power["clean"] > 1e-3 * power["clean"].amax(1, keepdim=True)
        human = (power["clean"] * loud).sum(1) / loud.sum(1).clamp(min=1)
        level = torch.maximum(human, LOUD_REST * power["mic"].mean(1)) + 1e-12
        unit = (self.stft.n_fft * self.stft.noise_gain() / 2) ** 0.5
        scale = (TARGET_RMS * unit / level.sqrt())[:, None, None, None]
        return {name: scale * spectrum for name, spectrum in batch.items()} | {
            "d_vector": torch.from_numpy(np.ascontiguousarray(voice, np.float32))
        }


def _cut(rng: np.random.Generator, item: Item, samples: int) -> tuple[Samples, Samples]:
    """Microphone and human (samples,) float32 of a crop at random; a shorter item is followed by silence."""
    at = int(rng.integers(max(item.mic.size - samples, 0) + 1))
    cut = [np.float32(item.scale) * signal[at : at + samples] for signal in (item.mic, item.clean)]
    mic, clean = (np.pad(signal, (0, samples - signal.size)) for signal in cut)
    return mic, clean


def _rms(samples: Samples) -> float:
    return float(np.sqrt(np.mean(samples**2)))
