"""Train the edge network for some minutes on conversations that the device simulates meanwhile, and keep what was learned on the way.

    python -m export.gpu.train --speech speech.zip --output DIR [--minutes 8] [--start WEIGHTS.pt] [--smoke] [options of export.train]

speech.zip is export.gpu.speech's. All that runs is torch, on one GPU where there is one: speech is read once, conversations
are rendered in batches and put into the device's memory, the oldest make room, and a step sees crops of them with
export.train's augmentation. Every --every steps DIR gets weights.pt (the averaged weights, export.checkpoint's) and a line in
log.jsonl, validated on conversations of the archive's validation voices, the same each time; weights.pt also each KEEP_S.
The minutes count from the program's start. --smoke: seconds of data, some steps, on any processor. Besides torch it needs
numpy, scipy, soundfile, tqdm, tensorboard, lazy-loader, onnx and onnxruntime.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from edgefilter.errors import EdgefilterError, UsageError
from export import train
from export.checkpoint import shrink
from export.crops import Shape
from export.gpu import speech
from export.gpu.scenes import Scenes
from export.items import POWERS, STORED, Items
from export.processes import Processes
from export.simulate.linear_stage import from_bytes
from export.simulate.recipe import RECIPES
from export.tasks import EdgeTask
from export.trainer import Plan, Trainer, write_whole

NEWEST = Path(__file__).parents[2] / "models" / "version2_bands_step38834.pt"
"""The checkpoint that training goes on from."""
VALIDATION_SEED = 102
"""Of the validation items, whatever the training's seed."""
KEEP_S = 50.0
"""A machine that is lent may end at any moment: no more than a minute of training is lost, with the step under way."""
USUAL = {"--rate": "1e-3", "--batch": "64", "--every": "100", "--steps": "1000000", "--fan-kept": "0.2"}
"""Options of export.train that are others here: those of the shipped network's training, and ends by the clock."""
SMOKE = {"--batch": "2", "--every": "2", "--steps": "4", "--seconds": "0.25"}


class Pool(Items):
    """The newest `most` conversations in the device's memory; refresh() renders `batch` more."""

    def __init__(self, scenes: Scenes, batch: int, most: int) -> None:
        self.scenes, self.batch, self.most, self.device = scenes, batch, most, scenes.device
        self._items, self._rendered = {}, 0
        self._levels = torch.from_numpy(from_bytes(np.arange(256))).to(self.device)
        self._full_scale = torch.tensor(32767.0, device=self.device)
        self.refresh()

    def refresh(self) -> int:
        """Render more and return how many there are; those that are left out now are dropped a refresh later: a crop may be under way."""
        gone = self._rendered * self.batch - self.most
        kept = {name: item for name, item in self._items.items() if int(name) >= gone}
        batch = self.scenes.render(self._rendered, self.batch)
        for row in range(self.batch):
            item = {name: batch[name][row].clone() for name in (*STORED, *POWERS)}
            kept[f"{self._rendered * self.batch + row:08d}"] = item | {
                "scale": self._full_scale,
                "reference_scale": self._full_scale,
            }
        self._items, self._rendered = kept, self._rendered + 1
        self.names = sorted(kept)[-self.most :]
        return len(self.names)


class Keeper(Trainer):
    """A trainer that copies weights and log to a folder that outlasts the machine, at each validation; the weights also every KEEP_S seconds."""

    keep: Path

    def train(self, items: Items, held_out: Items) -> Path:
        self.items, self.kept = items, time.monotonic()
        return super().train(items, held_out)

    def _one(self, step: int, batch: Mapping[str, Tensor]) -> dict[str, float]:
        if time.monotonic() - self.kept > KEEP_S:
            write_whole(self._state(self.items), self.output / "between.pt")
            self._put("between.pt")
        return super()._one(step, batch)

    def _validate(self, *known: object) -> None:
        super()._validate(*known)
        self._put("last.pt")
        shutil.copy(self.output / "log.jsonl", self.keep)

    def _put(self, name: str) -> None:
        shrink(self.output / name, self.keep / "weights.part")
        (self.keep / "weights.part").replace(self.keep / "weights.pt")
        self.kept = time.monotonic()


def arguments(argv: list[str] | None) -> tuple[argparse.Namespace, list[str]]:
    """Own options, and those of export.train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speech", type=Path, required=True, metavar="FILE.zip")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--start", type=Path, default=NEWEST, metavar="WEIGHTS.pt")
    parser.add_argument("--recipe", choices=tuple(RECIPES), default="field")
    parser.add_argument("--rendered", type=int, default=512, help="conversations at once")
    parser.add_argument("--pool", type=int, default=6144, help="conversations in memory")
    parser.add_argument("--held-out", type=int, default=64, help="conversations to validate on")
    parser.add_argument("--smoke", action="store_true")
    return parser.parse_known_args(argv)


def run(options: argparse.Namespace, more: list[str], began: float) -> None:
    recipe = RECIPES[options.recipe]
    if options.smoke:
        recipe = replace(recipe, seconds=1.0)
        options.rendered, options.pool, options.held_out = 4, 6, 2
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        place, folder = Path(temporary) / "run", Path(temporary) / "speech"
        place.mkdir()
        words = [word for pair in (USUAL | (SMOKE if options.smoke else {})).items() for word in pair]
        training = train.arguments(
            [*words, "--data", str(folder), "--validation", str(folder), "--output", str(place), *more]
        )
        try:
            with zipfile.ZipFile(options.speech) as archive:
                archive.extractall(folder)
        except zipfile.BadZipFile as error:
            raise UsageError(
                f"{options.speech} is no archive of speech ({error}): make one with export.gpu.speech"
            ) from error
        torch.set_num_threads(training.threads)
        device = Processes.join().device
        task = EdgeTask(training, train.sizes_before("edge", options.start))
        held_out, items = (
            Pool(Scenes(recipe, task.stft, speech.read(folder, split, device), seed), batch, most)
            for split, seed, batch, most in (
                ("val", VALIDATION_SEED, options.held_out, options.held_out),
                ("train", training.seed, options.rendered, options.pool),
            )
        )
        print(f"{device}: speech and first conversations after {time.monotonic() - began:.0f} s", flush=True)
        minutes = options.minutes - (time.monotonic() - began) / 60
        plan = Plan(training.steps, training.rate, training.seed, training.every, minutes=minutes)
        shape = Shape(training.batch, training.seconds, training.long_every)
        trainer = Keeper(task, plan, shape, place, options.start)
        trainer.keep = options.output
        trainer.train(items, held_out)


def main(argv: list[str] | None = None) -> int:
    began = time.monotonic()
    try:
        run(*arguments(argv), began)
    except (EdgefilterError, OSError) as error:
        print(f"gpu.train: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
