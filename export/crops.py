"""Random stretches of the simulated conversations as batches of spectra."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE
from export.simulate.linear_stage import from_bytes

SIGNALS = ("error", "mic", "reference", "echo", "clean")
POWERS = ("noise", "residual")
STORED = ("mic", "error", "reference", "clean")
TARGET_RMS = 0.1
"""At which the human is scaled for the loss."""
SWAPPED = 0.3
"""Share of crops that get another conversation's human, at the level of the one that was there."""
GAIN_DB = 4.0
"""By which a crop's human is made louder or softer, at most: canceller and expected powers were made with the one that
was there."""
ROBOT_SILENT = 0.04
"""Share of crops in which the robot says nothing and the fan is faint: the human has to come out untouched."""
LOUD_REST = 0.1
"""Part of the error's power that the human is taken to have at least when crops are brought to one level: beside a crop
that holds only the end of a word and a loud robot, no other would count in the loss."""
NOTHING = 1e-9
"""Power per bin of a residual echo that is not there."""


class Items:
    """The dataset in memory; refresh() takes in what has been written since, so training can start before simulation ends.

    newest: how many are kept, None for all: older ones make room.
    """

    def __init__(self, folder: Path, newest: int | None = None) -> None:
        self.folder, self.newest = folder, newest
        self._items: dict[str, dict[str, np.ndarray]] = {}
        self.refresh()
        if not self._items:
            raise UsageError(f"{folder} holds no simulated items: make them with python -m export.dataset")

    def refresh(self) -> int:
        """Load new items and return how many there are."""
        paths = sorted(self.folder.glob("*.npz"))[-self.newest if self.newest else 0 :]
        new = [path for path in paths if path.name not in self._items]
        for path in tqdm(new, desc=f"read {self.folder}", unit="item", leave=False):
            with np.load(path) as file:
                if POWERS[0] not in file:
                    raise UsageError(
                        f"{path} holds no expected powers: simulate it again with python -m export.dataset"
                    )
                names = (*STORED, *POWERS, "scale", "reference_scale")
                self._items[path.name] = {name: file[name] for name in names}
        self._items = {path.name: self._items[path.name] for path in paths}
        self.names = sorted(self._items)
        return len(self.names)

    def crop(self, name: str, start: int, samples: int) -> dict[str, np.ndarray]:
        """(samples,) float32 of each stored signal, at their true scale."""
        item = self._items[name]
        return {
            signal: (
                (item["reference_scale" if signal == "reference" else "scale"] / 32767)
                * item[signal][start : start + samples].astype(np.float32)
            )
            for signal in STORED
        }

    def powers(self, name: str, start: int, samples: int, stft: StftConfig) -> dict[str, np.ndarray]:
        """(frames, bins) float32 of both expected powers, for the frames that lie wholly in the crop; start: whole hops.

        Empty where the item was simulated for another transform.
        """
        item = self._items[name]
        if item["noise"].shape != (item["mic"].size // stft.hop, stft.bins):
            return {}
        first, frames = start // stft.hop + 1, samples // stft.hop - 1
        return {power: from_bytes(item[power][first : first + frames]) for power in POWERS}

    def length(self, name: str) -> int:
        """Samples of that item."""
        return self._items[name]["mic"].size


@dataclass(frozen=True)
class Shape:
    """Batches of `batch` crops of `seconds`; every long_every-th (0: none) of a quarter as many, four times as long."""

    batch: int = 16
    seconds: float = 2.0
    long_every: int = 4

    def of(self, step: int) -> tuple[int, float]:
        """Crops and seconds of that step's batch."""
        if self.long_every and step % self.long_every == self.long_every - 1:
            return max(1, self.batch // 4), 4 * self.seconds
        return self.batch, self.seconds


class Batches:
    """Batches of crops with their augmentation, made on a thread ahead of training.

    The batch of a step depends on seed, step and rank, and on the items that are there.
    """

    def __init__(self, items: Items, stft: StftConfig, shape: Shape, seed: int, rank: int = 0) -> None:
        self.items, self.stft, self.shape, self.seed, self.rank = items, stft, shape, seed, rank
        self.rng = np.random.default_rng(seed)
        self._window = torch.from_numpy(stft.analysis_window.copy())
        self._ready: tuple[int, dict[str, Tensor]] | None = None
        self._thread: threading.Thread | None = None

    def draw(self, step: int) -> dict[str, Tensor]:
        """Spectra (batch, frames, bins, 2) by signal, powers (batch, frames, bins), "active" (batch, frames), "scale" (batch,) to TARGET_RMS."""
        if self._thread is not None:
            self._thread.join()
        if self._ready is None or self._ready[0] != step:
            self._prepare(step)
        assert self._ready is not None
        batch = self._ready[1]
        self._thread = threading.Thread(target=self._prepare, args=(step + 1,), daemon=True)
        self._thread.start()
        return batch

    def ends(self, names: list[str], seconds: float) -> dict[str, Tensor]:
        """The last seconds of these items, as they are."""
        samples = self._whole_hops(seconds)
        return self.spectra([self._cut(name, self.items.length(name) - samples, samples) for name in names])

    def _prepare(self, step: int) -> None:
        self.rng = np.random.default_rng([self.seed, step, self.rank])
        batch, seconds = self.shape.of(step)
        samples = self._whole_hops(seconds)
        self._ready = (
            step,
            self.spectra([self._crop(str(n), samples) for n in self.rng.choice(self.items.names, batch)]),
        )

    def _whole_hops(self, seconds: float) -> int:
        return int(seconds * SAMPLE_RATE) // self.stft.hop * self.stft.hop

    def _start(self, name: str, samples: int) -> int:
        """A random place, whole hops from the item's start."""
        return int(self.rng.integers((self.items.length(name) - samples) // self.stft.hop + 1)) * self.stft.hop

    def _cut(self, name: str, start: int, samples: int) -> dict[str, np.ndarray]:
        return self.items.crop(name, start, samples) | self.items.powers(name, start, samples, self.stft)

    def _crop(self, name: str, samples: int) -> dict[str, np.ndarray]:
        rng = self.rng
        crop = self._cut(name, self._start(name, samples), samples)
        if rng.random() < SWAPPED:
            self._swap_human(crop)
        if rng.random() < ROBOT_SILENT:
            self._silence_robot(crop)
        gain = 10 ** (rng.uniform(-GAIN_DB, GAIN_DB) / 20) - 1
        for signal in ("mic", "error"):
            crop[signal] = crop[signal] + gain * crop["clean"]
        crop["clean"] = (1 + gain) * crop["clean"]
        level, told = 10 ** (rng.uniform(-12, 18) / 20), 10 ** (rng.uniform(-8, 8) / 20)
        scales = {"reference": told, "noise": level**2, "residual": level**2}
        return {signal: scales.get(signal, level) * samples for signal, samples in crop.items()}

    def _swap_human(self, crop: dict[str, np.ndarray]) -> None:
        """Put another human, from another conversation, in the place of the one that is there; now and then nobody."""
        other, samples = str(self.rng.choice(self.items.names)), crop["clean"].size
        clean = self.items.crop(other, self._start(other, samples), samples)["clean"]
        here, there = (float(np.sqrt(np.mean(x**2))) for x in (crop["clean"], clean))
        if here == 0.0 or there == 0.0:
            return
        clean = (here / there) * clean
        for signal in ("mic", "error"):
            crop[signal] = crop[signal] - crop["clean"] + clean
        crop["clean"] = clean

    def _silence_robot(self, crop: dict[str, np.ndarray]) -> None:
        """Only the human, and white noise 30 to 60 dB below the loudest sample."""
        samples = crop["clean"].size
        peak = float(np.abs(crop["clean"]).max()) or 0.01
        rms = 10 ** (-self.rng.uniform(30, 60) / 20) * peak
        crop["mic"] = crop["error"] = crop["clean"] + rms * self.rng.standard_normal(samples, np.float32)
        crop["reference"] = np.zeros(samples, np.float32)
        for power, level in (("noise", rms**2 * self.stft.noise_gain()), ("residual", NOTHING)):
            if power in crop:
                crop[power] = np.full_like(crop[power], level)

    def spectra(self, crops: list[dict[str, np.ndarray]]) -> dict[str, Tensor]:
        """Crops of equal length to a batch."""
        for crop in crops:
            crop["echo"] = crop["mic"] - crop["error"]
        batch = {}
        for signal in SIGNALS:
            samples = torch.from_numpy(np.stack([crop[signal] for crop in crops]).astype(np.float32))
            frames = samples.unfold(1, self.stft.window_length, self.stft.hop) * self._window
            batch[signal] = torch.view_as_real(torch.fft.rfft(frames, self.stft.n_fft))
        for power in POWERS:
            if all(power in crop for crop in crops):
                batch[power] = torch.from_numpy(np.stack([crop[power] for crop in crops]).astype(np.float32))
        batch["active"], level = _activity(batch["clean"])
        unit = (self.stft.n_fft * self.stft.noise_gain() / 2) ** 0.5
        left = batch["error"].square().sum((2, 3)).mean(1)
        batch["scale"] = TARGET_RMS * unit / (torch.maximum(level, LOUD_REST * left) + 1e-12).sqrt()
        return batch


def _activity(clean: Tensor) -> tuple[Tensor, Tensor]:
    """Frames in which the human speaks, 0 or 1 (batch, frames), and the human's mean power in them (batch,)."""
    power = clean.square().sum((2, 3))
    active = ((power > 10**-3.5 * power.amax(1, keepdim=True)) & (power > 1e-9)).float()
    return active, (power * active).sum(1) / active.sum(1).clamp(min=1)
