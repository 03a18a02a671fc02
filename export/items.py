"""The simulated conversations on disk, as training reads them."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import torch
from numpy.lib import format as npy
from torch import Tensor
from tqdm import tqdm

from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import UsageError
from export.simulate.linear_stage import from_bytes

POWERS = ("noise", "residual")
STORED = ("mic", "error", "reference", "clean", "fan")
LOCAL_HEADER, NAME_LENGTHS_AT = 30, 26
"""Bytes before an entry's name in a zip file, and where the lengths of name and extra field stand in them (APPNOTE 4.3.7)."""


def mapped(path: Path) -> dict[str, np.ndarray]:
    """Arrays by name of a file that numpy.savez wrote, read from the disk when they are used.

    Raises UsageError for a file that is none, is cut short, or holds compressed arrays.
    """
    try:
        whole = np.memmap(path, np.uint8, "c")
        with zipfile.ZipFile(path) as archive:
            return {entry.filename.removesuffix(".npy"): _view(whole, archive, entry) for entry in archive.infolist()}
    except (zipfile.BadZipFile, ValueError) as error:
        remedy = "delete it, and simulate it again with python -m export.dataset"
        raise UsageError(f"{path} is not a whole simulated item ({error}): {remedy}") from error


def _view(whole: np.ndarray, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    if entry.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{entry.filename} is compressed")
    lengths = bytes(whole[entry.header_offset + NAME_LENGTHS_AT :][:4])
    begin = entry.header_offset + LOCAL_HEADER + sum(struct.unpack("<HH", lengths))
    with archive.open(entry) as file:
        npy.read_magic(file)
        shape, _, dtype = npy.read_array_header_1_0(file)
        begin += file.tell()
    return np.ndarray(shape, dtype, whole, begin)


class Items:
    """The dataset; refresh() takes in what has been written since, so training can start before simulation ends.

    newest: how many are kept, None for all: older ones make room. device: whose memory. A processor maps the files, so
    that several trainings share what they read and none needs room for all; a GPU crops faster from its own memory.
    """

    def __init__(self, folder: Path, newest: int | None = None, device: torch.device = torch.device("cpu")) -> None:
        self.folder, self.newest, self.device = folder, newest, device
        self._items: dict[str, dict[str, Tensor]] = {}
        self._levels = torch.from_numpy(from_bytes(np.arange(256))).to(device)
        self.refresh()
        if not self._items:
            raise UsageError(f"{folder} holds no simulated items: make them with python -m export.dataset")

    def refresh(self) -> int:
        """Load new items and return how many there are."""
        paths = sorted(self.folder.glob("*.npz"))[-self.newest if self.newest else 0 :]
        new = [path for path in paths if path.name not in self._items]
        for path in tqdm(new, desc=f"read {self.folder}", unit="item", leave=False):
            found = mapped(path)
            names = (*STORED, *POWERS, "scale", "reference_scale")
            if missing := [name for name in names if name not in found]:
                remedy = "simulate it again with python -m export.dataset"
                raise UsageError(f"{path} holds no {' and no '.join(missing)}: {remedy}")
            self._items[path.name] = {name: torch.from_numpy(found[name]).to(self.device) for name in names}
        self._items = {path.name: self._items[path.name] for path in paths}
        self.names = sorted(self._items)
        return len(self.names)

    def crops(
        self, places: list[tuple[str, int]], samples: int, signals: tuple[str, ...] = STORED
    ) -> dict[str, Tensor]:
        """Samples of each of these stored signals, at their true scale, (places, samples) float32; places: item and first sample."""
        found = {}
        for signal in signals:
            scale = "reference_scale" if signal == "reference" else "scale"
            cut = torch.stack([self._items[name][signal][at : at + samples] for name, at in places])
            found[signal] = cut * torch.stack([self._items[name][scale] for name, _ in places])[:, None] / 32767
        return found

    def powers(self, places: list[tuple[str, int]], samples: int, stft: StftConfig) -> dict[str, Tensor]:
        """Both expected powers, for the frames that lie wholly in the crops, (places, frames, bins) float32 each.

        places: as for crops(), whole hops from the item's start. Empty where an item was simulated for another
        transform.
        """
        if any(self._items[name]["noise"].shape != (self.length(name) // stft.hop, stft.bins) for name, _ in places):
            return {}
        frames = samples // stft.hop - 1
        firsts = [(name, at // stft.hop + 1) for name, at in places]
        return {
            power: self._levels[torch.stack([self._items[n][power][t : t + frames] for n, t in firsts]).long()]
            for power in POWERS
        }

    def length(self, name: str) -> int:
        """Samples of that item."""
        return self._items[name]["mic"].shape[0]
