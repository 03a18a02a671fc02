"""Random stretches of the simulated conversations as batches of spectra."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE

SIGNALS = ("error", "mic", "reference", "echo", "clean")
TARGET_RMS = 0.1
"""At which the human is scaled for the loss."""
ROBOT_SILENT = 0.06
"""Share of crops in which the robot says nothing and the fan is faint: the human has to come out untouched."""


class Items:
    """The dataset in memory; refresh() takes in what has been written since, so training can start before simulation ends."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._items: dict[str, dict[str, np.ndarray]] = {}
        self.refresh()
        if not self._items:
            raise UsageError(f"{folder} holds no simulated items: make them with python -m export.dataset")

    def refresh(self) -> int:
        """Load new items and return how many there are."""
        new = [path for path in sorted(self.folder.glob("*.npz")) if path.name not in self._items]
        for path in tqdm(new, desc=f"read {self.folder}", unit="item", leave=False):
            with np.load(path) as file:
                self._items[path.name] = {
                    name: file[name] for name in ("mic", "error", "reference", "clean", "scale", "reference_scale")
                }
        self.names = sorted(self._items)
        return len(self.names)

    def crop(self, name: str, start: int, samples: int) -> dict[str, np.ndarray]:
        """(samples,) float32 of each signal but the echo, at their true scale."""
        item = self._items[name]
        return {
            signal: (
                (item["reference_scale" if signal == "reference" else "scale"] / 32767)
                * item[signal][start : start + samples].astype(np.float32)
            )
            for signal in ("mic", "error", "reference", "clean")
        }

    def length(self, name: str) -> int:
        """Samples of that item."""
        return self._items[name]["mic"].size


class Batches:
    """Batches of crops with their augmentation, made on a thread ahead of training."""

    def __init__(
        self, items: Items, stft: StftConfig, batch: int, seconds: float, seed: int, augment: bool = True
    ) -> None:
        self.items, self.stft, self.batch, self.augment = items, stft, batch, augment
        self.samples = int(seconds * SAMPLE_RATE) // stft.hop * stft.hop
        self.rng = np.random.default_rng(seed)
        self._window = torch.from_numpy(stft.analysis_window.copy())
        self._next: dict[str, Tensor] | None = None
        self._thread: threading.Thread | None = None

    def draw(self) -> dict[str, Tensor]:
        """Spectra (batch, frames, bins, 2) by signal, "active" (batch, frames), "scale" (batch,) to TARGET_RMS."""
        if self._thread is None:
            self._start()
        self._thread.join()
        ready = self._next
        self._start()
        return ready

    def _start(self) -> None:
        self._thread = threading.Thread(target=self._prepare, daemon=True)
        self._thread.start()

    def _prepare(self) -> None:
        self._next = self.spectra([self._crop(str(name)) for name in self.rng.choice(self.items.names, self.batch)])

    def _crop(self, name: str) -> dict[str, np.ndarray]:
        rng = self.rng
        crop = self.items.crop(name, int(rng.integers(self.items.length(name) - self.samples + 1)), self.samples)
        if not self.augment:
            return crop
        if rng.random() < 0.4:
            self._swap_human(crop)
        if rng.random() < ROBOT_SILENT:
            self._silence_robot(crop)
        gain = 10 ** (rng.uniform(-6, 6) / 20) - 1
        for signal in ("mic", "error"):
            crop[signal] = crop[signal] + gain * crop["clean"]
        crop["clean"] = (1 + gain) * crop["clean"]
        level, told = 10 ** (rng.uniform(-12, 18) / 20), 10 ** (rng.uniform(-8, 8) / 20)
        return {signal: (told if signal == "reference" else level) * samples for signal, samples in crop.items()}

    def _swap_human(self, crop: dict[str, np.ndarray]) -> None:
        """Put another human, from another conversation, in the place of the one that is there; now and then nobody."""
        other = str(self.rng.choice(self.items.names))
        clean = self.items.crop(
            other, int(self.rng.integers(self.items.length(other) - self.samples + 1)), self.samples
        )["clean"]
        here, there = (float(np.sqrt(np.mean(x**2))) for x in (crop["clean"], clean))
        if here == 0.0 or there == 0.0:
            return
        clean = (here / there) * clean
        for signal in ("mic", "error"):
            crop[signal] = crop[signal] - crop["clean"] + clean
        crop["clean"] = clean

    def _silence_robot(self, crop: dict[str, np.ndarray]) -> None:
        """Only the human, and white noise 30 to 60 dB below the loudest sample."""
        peak = float(np.abs(crop["clean"]).max()) or 0.01
        noise = 10 ** (-self.rng.uniform(30, 60) / 20) * peak * self.rng.standard_normal(self.samples, np.float32)
        crop["mic"] = crop["error"] = crop["clean"] + noise
        crop["reference"] = np.zeros(self.samples, np.float32)

    def spectra(self, crops: list[dict[str, np.ndarray]]) -> dict[str, Tensor]:
        """Crops of equal length to a batch."""
        for crop in crops:
            crop["echo"] = crop["mic"] - crop["error"]
        batch = {}
        for signal in SIGNALS:
            samples = torch.from_numpy(np.stack([crop[signal] for crop in crops]).astype(np.float32))
            frames = samples.unfold(1, self.stft.window_length, self.stft.hop) * self._window
            batch[signal] = torch.view_as_real(torch.fft.rfft(frames, self.stft.n_fft))
        clean, error = batch["clean"], batch["error"]
        power = clean.square().sum((2, 3))
        loudest = power.amax(1, keepdim=True)
        batch["active"] = ((power > 10**-3.5 * loudest) & (power > 1e-9)).float()
        count = batch["active"].sum(1).clamp(min=1)
        speech = (power * batch["active"]).sum(1) / count
        level = torch.where(loudest.squeeze(1) > 1e-9, speech, error.square().sum((2, 3)).mean(1))
        batch["scale"] = TARGET_RMS * (self.stft.n_fft * self.stft.noise_gain() / 2) ** 0.5 / (level + 1e-12).sqrt()
        return batch
