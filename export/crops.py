"""Random stretches of the simulated conversations as batches of spectra."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from edgefilter.dsp.stft import StftConfig
from edgefilter.types import SAMPLE_RATE
from export.items import POWERS, Items
from export.network import erb_rate

TARGET_RMS = 0.1
"""At which the human is scaled for the loss."""
SWAPPED = 0.3
"""Share of crops that get another conversation's human, at the level of the one that was there."""
GAIN_DB, LEVEL_DB, TOLD_DB = (4.0, 4.0), (12.0, 18.0), (8.0, 8.0)
"""By which a crop's human, all that is heard and the reference are made softer and louder, at most; the human by little,
since canceller and expected powers were made with the one that was there."""
ROBOT_SILENT = 0.04
"""Share of crops in which the robot says nothing and the fan is faint: the human has to come out untouched."""
COLOURED, COLOUR_DB, WAVES = 0.5, 4.0, 4
"""Share of crops in which microphone, human and reference each get another frequency response, and of how many waves along
the ear's scale, each up to so deep, that is: other devices and voices than the ones that were simulated."""
LOUD_REST = 0.1
"""Least human power assumed when a crop is scaled to one level for the human, as a part of the linear stage's error: a crop with the end of a
word beside a loud robot would else be scaled up until the loss saw nothing but it."""
ONSET, ONSET_S, QUIET_S = 4.0, 0.3, 0.5
"""How much more the speech head answers for the first seconds of a human than for the rest, and after how many without one."""
NOTHING = 1e-9
"""Power per bin of a residual echo that is not there."""


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
        self._window = torch.from_numpy(stft.analysis_window.copy()).to(items.device)
        self._ready: tuple[int, dict[str, Tensor]] | None = None
        self._thread: threading.Thread | None = None

    def draw(self, step: int) -> dict[str, Tensor]:
        """A batch: spectra (batch, frames, bins, 2) by signal, powers (batch, frames, bins), "active", "heed" (batch, frames), "scale" (batch,).

        scale: to TARGET_RMS.
        """
        if self._thread is not None:
            self._thread.join()
        if self._ready is None or self._ready[0] != step:
            self._prepare(step)
        assert self._ready is not None
        batch = self._ready[1]
        self._thread = threading.Thread(target=self._prepare, args=(step + 1,))
        self._thread.start()
        return batch

    def ends(self, names: list[str], seconds: float) -> dict[str, Tensor]:
        """The last seconds of the items of these names, unprocessed."""
        samples = self._whole_hops(seconds)
        places = [(name, self.items.length(name) // self.stft.hop * self.stft.hop - samples) for name in names]
        return _weighed(self._spectra(self._cut(places, samples)), self.stft)

    def _prepare(self, step: int) -> None:
        rng = np.random.default_rng([self.seed, step, self.rank])
        batch, seconds = self.shape.of(step)
        samples = self._whole_hops(seconds)
        crops = self._cut(self._places(rng, batch, samples), samples)
        others = self._places(rng, batch, samples)
        swapped, silent = rng.random((2, batch)) < np.array([[SWAPPED], [ROBOT_SILENT]])
        self._swap_humans(crops, others, swapped)
        self._silence_robots(crops, rng, silent)
        gain, level, told = (
            self._each(10 ** (rng.uniform(-low, high, batch) / 20)) for low, high in (GAIN_DB, LEVEL_DB, TOLD_DB)
        )
        louder = (gain - 1) * crops["clean"]
        for signal in ("mic", "error", "clean"):
            crops[signal] = level * (crops[signal] + louder)
        crops["fan"] = level * crops["fan"]
        crops["reference"] = told * crops["reference"]
        for power in POWERS:
            if power in crops:
                crops[power] = level.square()[..., None] * crops[power]
        spectra = self._spectra(crops)
        self._colour(spectra, rng)
        self._ready = step, _weighed(spectra, self.stft)

    def _each(self, values: np.ndarray) -> Tensor:
        """One number a crop, (batch, 1)."""
        return torch.from_numpy(values.astype(np.float32)).to(self.items.device)[:, None]

    def _whole_hops(self, seconds: float) -> int:
        return int(seconds * SAMPLE_RATE) // self.stft.hop * self.stft.hop

    def _places(self, rng: np.random.Generator, count: int, samples: int) -> list[tuple[str, int]]:
        """Items and places in them at random, whole hops from the item's start."""
        hop, names = self.stft.hop, [str(name) for name in rng.choice(self.items.names, count)]
        return [(name, int(rng.integers((self.items.length(name) - samples) // hop + 1)) * hop) for name in names]

    def _cut(self, places: list[tuple[str, int]], samples: int) -> dict[str, Tensor]:
        return self.items.crops(places, samples) | self.items.powers(places, samples, self.stft)

    def _swap_humans(self, crops: dict[str, Tensor], others: list[tuple[str, int]], swapped: np.ndarray) -> None:
        """Put another human, from another conversation, in the place of one that is there, where there is somebody in both."""
        chosen = [int(row) for row in np.flatnonzero(swapped)]
        if not chosen:
            return
        clean = crops["clean"][chosen]
        other = self.items.crops([others[row] for row in chosen], clean.shape[1], ("clean",))["clean"]
        here, there = (x.square().mean(1, keepdim=True).sqrt() for x in (clean, other))
        other = torch.where((here > 0) & (there > 0), here / there.clamp(min=1e-9) * other, clean)
        for signal in ("mic", "error", "clean"):
            crops[signal][chosen] += other - clean

    def _silence_robots(self, crops: dict[str, Tensor], rng: np.random.Generator, silent: np.ndarray) -> None:
        """Only the human, and white noise 30 to 60 dB below the loudest sample."""
        for row in np.flatnonzero(silent):
            clean = crops["clean"][row]
            rms = 10 ** (-rng.uniform(30, 60) / 20) * (float(clean.abs().max()) or 0.01)
            noise = torch.from_numpy(rng.standard_normal(clean.shape[0], np.float32)).to(clean.device)
            crops["fan"][row] = rms * noise
            crops["mic"][row] = crops["error"][row] = clean + rms * noise
            crops["reference"][row] = 0.0
            for power, level in (("noise", rms**2 * self.stft.noise_gain()), ("residual", NOTHING)):
                if power in crops:
                    crops[power][row] = level

    def _spectra(self, crops: dict[str, Tensor]) -> dict[str, Tensor]:
        """Turn signals (batch, samples) and the echo into spectra; powers stay as they are."""
        batch = {power: crops[power] for power in POWERS if power in crops}
        for signal, samples in (crops | {"echo": crops["mic"] - crops["error"]}).items():
            if signal not in POWERS:
                frames = samples.unfold(1, self.stft.window_length, self.stft.hop) * self._window
                batch[signal] = torch.view_as_real(torch.fft.rfft(frames, self.stft.n_fft))
        return batch

    def _colour(self, batch: dict[str, Tensor], rng: np.random.Generator) -> None:
        """Other frequency responses of microphone, human and reference in some of the crops; what is expected follows."""
        count = batch["mic"].shape[0]
        some = rng.random((count, 1)) < COLOURED
        heard, human, told = (
            torch.from_numpy(np.where(some, colours(rng, count, self.stft), 1).astype(np.float32))
            .to(self.items.device)
            .reshape(count, 1, -1, 1)
            for _ in range(3)
        )
        other = (human - 1) * batch["clean"]
        for signal in ("mic", "error", "clean"):
            batch[signal] = heard * (batch[signal] + other)
        for signal in ("fan", "echo"):
            batch[signal] = heard * batch[signal]
        batch["reference"] = told * batch["reference"]
        for power in POWERS:
            if power in batch:
                batch[power] = heard[..., 0].square() * batch[power]


def colours(rng: np.random.Generator, count: int, stft: StftConfig) -> np.ndarray:
    """Gains of smooth frequency responses at random, (count, bins)."""
    place = erb_rate(stft.frequencies) / erb_rate(stft.frequencies[-1])
    depth, phase = rng.uniform(0, COLOUR_DB, (count, WAVES)), rng.uniform(0, 2 * np.pi, (count, WAVES))
    waves = np.cos(np.pi * np.arange(1, WAVES + 1)[:, None] * place + phase[..., None])
    return 10 ** (np.einsum("cw,cwf->cf", depth, waves) / 20)


def _weighed(batch: dict[str, Tensor], stft: StftConfig) -> dict[str, Tensor]:
    """The batch with "active", "heed" and "scale"."""
    active, level = _activity(batch["clean"])
    unit = (stft.n_fft * stft.noise_gain() / 2) ** 0.5
    left = batch["error"].square().sum((2, 3)).mean(1)
    scale = TARGET_RMS * unit / (torch.maximum(level, LOUD_REST * left) + 1e-12).sqrt()
    return batch | {"active": active, "heed": heed(active, stft.hop), "scale": scale}


def _activity(clean: Tensor) -> tuple[Tensor, Tensor]:
    """Frames in which the human speaks, 0 or 1 (batch, frames), and the human's mean power in them (batch,)."""
    power = clean.square().sum((2, 3))
    active = ((power > 10**-3.5 * power.amax(1, keepdim=True)) & (power > 1e-9)).float()
    return active, (power * active).sum(1) / active.sum(1).clamp(min=1)


def heed(active: Tensor, hop: int) -> Tensor:
    """Weight of each frame (batch, frames) for the speech head: ONSET in a human's first ONSET_S after QUIET_S without, else 1."""
    quiet, onset = (max(1, round(seconds * SAMPLE_RATE / hop)) for seconds in (QUIET_S, ONSET_S))
    before = active.cumsum(1)
    spoken = before - torch.nn.functional.pad(before, (quiet + 1, 0))[:, : active.shape[1]]
    begins = (active > 0) & (spoken == 1)
    begins[:, :quiet] = False
    since = begins.float().cumsum(1)
    lately = since - torch.nn.functional.pad(since, (onset, 0))[:, : active.shape[1]]
    return torch.where(lately > 0, ONSET, 1.0)
