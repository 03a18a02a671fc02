"""The training loop: steps, averaged weights, validation, checkpoints, on one process or several."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE
from export.crops import Batches, Shape
from export.items import Items
from export.losses import si_sdr
from export.onnx_export import load
from export.processes import Processes
from export.tasks import Task

WARM_UP = 300
"""Steps over which the learning rate rises, at most; a tenth of a short training."""
FALL = 0.2
"""Last part of the steps, over which the rate falls to zero. Before, it stays: --steps may be changed on the way."""
HALF = torch.cuda.is_available() or "AVX512" in torch.backends.cpu.get_cpu_capability()
"""Whether bfloat16 is computed in hardware. Where torch emulates it, passes take 2.5 times as long as in float32, and Muon 25 times."""
AVERAGED = 500
"""Steps over which weights are averaged, at most; a short training averages over its last 25th."""
HELD_OUT_S = 8.0
"""Seconds of each validation item, its last."""


@dataclass(frozen=True)
class Plan:
    """How long and how fast.

    every: steps between validations. patience: validations without a better score before the end, 0 for never. minutes:
    after which training ends if it has not before, None for whenever.
    """

    steps: int
    rate: float
    seed: int
    every: int
    patience: int = 0
    minutes: float | None = None

    def done_at(self, step: int, seconds: float = 0.0) -> float:
        """Part of the training that is behind, by steps or by time, whichever is more."""
        return max(step / self.steps, seconds / (60 * self.minutes) if self.minutes else 0.0)

    def rate_at(self, step: int, seconds: float = 0.0) -> float:
        """Learning rate: a rise, long the same, a fall to zero."""
        rise = (step + 1) / min(WARM_UP, self.steps / 10)
        fall = (1.0 - self.done_at(step, seconds)) / FALL
        return self.rate * max(0.0, min(1.0, rise, fall)) + 1e-6

    def kept_at(self, step: int) -> float:
        """Weight of the past in the averaged weights."""
        return min(1 - 1 / min(AVERAGED, max(2.0, self.steps / 25)), (step + 1) / (step + 10))


class Trainer:
    """Trains one network into a folder: last.pt to go on from, best.pt by validation loss, log.jsonl.

    start: a checkpoint of a network whose weights are the first; they have to fit, and those of a network of bands fit
    every transform. Raises UsageError where they do not, and where the training in the folder is of another network.
    """

    def __init__(self, task: Task, plan: Plan, shape: Shape, output: Path, start: Path | None = None) -> None:
        self.task, self.plan, self.shape, self.output = task, plan, shape, output
        torch.manual_seed(plan.seed)
        self.processes = Processes.join()
        device = self.processes.device
        self.network = task.network().to(device)
        self.before: Mapping[str, object] = self._take(start) if start else {}
        self.average = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.optimisers = optimisers(self.network, plan.rate)
        self.step, self.best, self.since, self.seconds = 0, -math.inf, 0, 0.0
        self._resume(output / "last.pt", device)

    def run(self, data: Path, validation: Path, newest: int | None = None) -> Path:
        """Train on items until the plan is done; returns the best checkpoint. newest: see Items."""
        items, held_out = (
            Items(folder, count, self._device()) for folder, count in ((data, newest), (validation, None))
        )
        return self.train(items, held_out)

    def train(self, items: Items, held_out: Items) -> Path:
        """Train on these, wherever they come from."""
        draw = self._draws(items)
        print(f"{self.task.describe(self.network)}; {len(items.names)} items, from step {self.step}", flush=True)
        steps = range(self.step, self.plan.steps)
        board = SummaryWriter(self.output) if self.processes.rank == 0 else None
        with tqdm(steps, initial=self.step, total=self.plan.steps, disable=board is None) as progress:
            began = time.perf_counter() - self.seconds
            for step in progress:
                shown = self._one(step, draw(step))
                progress.set_postfix(loss=f"{shown['total']:.4f}", si_sdr=f"{-shown['si_sdr']:.1f}")
                self.step, self.seconds = step + 1, time.perf_counter() - began
                over = self.processes.agree(self.plan.done_at(self.step, self.seconds) >= 1.0, self._device())
                if self.step % self.plan.every and not over:
                    continue
                if board:
                    self._validate(items, held_out, board, shown["total"])
                items.refresh()
                if over or self.processes.agree(0 < self.plan.patience <= self.since, self._device()):
                    break
        if board:
            board.close()
        return self.output / "best.pt"

    def _draws(self, items: Items) -> Callable[[int], dict[str, Tensor]]:
        """What gives the batch of a step."""
        return Batches(items, self.task.stft, self.shape, self.plan.seed, self.processes.rank).draw

    def _figures(self, network: nn.Module, held_out: Items) -> dict[str, float]:
        """What a network reaches on held-out items, "total" being the loss."""
        return validate(self.task, network, held_out, HELD_OUT_S)

    def _one(self, step: int, batch: Mapping[str, Tensor]) -> dict[str, float]:
        """One step; returns the loss terms."""
        for group in (group for optimiser in self.optimisers for group in optimiser.param_groups):
            group["lr"] = self.plan.rate_at(step, self.seconds)
        terms, _ = self.task.loss(self.network, on(self._device(), batch))
        self.network.zero_grad(set_to_none=True)
        terms["total"].backward()
        self.processes.share(self.network)
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        if torch.isfinite(norm):
            for optimiser in self.optimisers:
                optimiser.step()
        keep = self.plan.kept_at(step)
        for name, value in self.network.state_dict().items():
            if value.dtype.is_floating_point:
                self.average[name].mul_(keep).add_(value, alpha=1 - keep)
            else:
                self.average[name].copy_(value)
        return {name: float(value.detach()) for name, value in terms.items()}

    def _validate(self, items: Items, held_out: Items, board: SummaryWriter, loss: float) -> None:
        """Validate the averaged weights and write what training goes on from, and the weights where they are the best."""
        averaged = self.task.network().to(self._device())
        averaged.load_state_dict(self.average)
        figures = self._figures(averaged, held_out)
        score = -figures["total"]
        self.since = 0 if score > self.best else self.since + 1
        state = self._state(items) | {"figures": figures}
        if score > self.best:
            self.best = score
            write_whole(state, self.output / "best.pt")
        here = {"step": self.step, "best": self.best, "since": self.since, "seconds": self.seconds}
        here |= {
            "running": self.network.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self.optimisers],
        }
        write_whole(state | {"resume": here}, self.output / "last.pt")
        board.add_scalar("train/total", loss, self.step)
        for name, value in figures.items():
            board.add_scalar(f"validation/{name}", value, self.step)
        line = {"step": self.step, "seconds": round(self.seconds), "items": len(items.names)}
        with (self.output / "log.jsonl").open("a", encoding="utf-8") as log:
            log.write(json.dumps(line | {k: round(v, 5) for k, v in figures.items()}) + "\n")
        tqdm.write(f"step {self.step}: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()))

    def _state(self, items: Items) -> dict[str, object]:
        """What a checkpoint holds of the averaged weights."""
        said = in_stages(self.before, self.step, self.plan.seed, len(items.names))
        return {"kind": self.task.kind, "config": self.task.config(), **said, "network": self.average}

    def _device(self) -> torch.device:
        return next(self.network.parameters()).device

    def _take(self, start: Path) -> Mapping[str, object]:
        """Weights of a trained network; returns what it says of its training."""
        loaded = load(start)
        try:
            self.network.load_state_dict(loaded.network.state_dict())
        except RuntimeError as error:
            found, wanted = loaded.network.config, self.network.config
            raise UsageError(f"{start} holds a network of {found}, expected {wanted}: {self.task.remedy}") from error
        return loaded.training

    def _resume(self, last: Path, device: torch.device) -> None:
        """Go on where a training into the same folder ended."""
        if not last.exists():
            return
        saved = torch.load(last, map_location=device, weights_only=True)
        wanted = self.network.config
        if (found := type(wanted)(**saved["config"])) != wanted:
            remedy = f"{self.task.remedy}, or another --output"
            raise UsageError(f"{last} is of a training of {found}, expected {wanted}: {remedy}")
        resume, self.average = saved["resume"], saved["network"]
        self.network.load_state_dict(resume["running"])
        for optimiser, state in zip(self.optimisers, resume["optimisers"], strict=True):
            optimiser.load_state_dict(state)
        self.step, self.best, self.since = resume["step"], resume["best"], resume["since"]
        self.seconds = resume["seconds"]


class Muon(torch.optim.Muon):
    """torch's, which orthogonalises in bfloat16, also on a processor that would emulate it: there in float32."""

    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        if HALF:
            return super().step(closure)
        with patch.object(Tensor, "bfloat16", Tensor.float):
            return super().step(closure)


def optimisers(network: nn.Module, rate: float) -> list[torch.optim.Optimizer]:
    """Muon (Jordan et al. 2024) for the matrices of linear layers and GRU, AdamW for all else, with the same rate.

    Muon's steps are as large as AdamW's (Liu et al. 2025, "Muon is scalable for LLM training", eq. (4)).
    """
    trained = [weight for weight in network.parameters() if weight.requires_grad]
    matrices = [weight for weight in trained if weight.ndim == 2 and min(weight.shape) > 1]
    others = [weight for weight in trained if weight.ndim != 2 or min(weight.shape) == 1]
    adam = torch.optim.AdamW(others, lr=rate, weight_decay=1e-2, betas=(0.9, 0.98))
    muon = [Muon(matrices, lr=rate, weight_decay=1e-2, adjust_lr_fn="match_rms_adamw")] if matrices else []
    return [*muon, adam]


def write_whole(state: Mapping[str, object], path: Path) -> None:
    """Whole or not at all: training may be stopped at any moment."""
    part = path.with_suffix(".part")
    torch.save(state, part)
    part.replace(path)


@torch.no_grad()
def validate(task: Task, network: nn.Module, items: Items, seconds: float) -> dict[str, float]:
    """Mean loss terms over the last `seconds` of every item, SI-SDR of the estimate and of the linear stage's error, active frames kept."""
    network.eval()
    device = next(network.parameters()).device
    batches = Batches(items, task.stft, Shape(), seed=0)
    sums: dict[str, float] = {}
    for at in range(0, len(items.names), 8):
        names = items.names[at : at + 8]
        batch = on(device, batches.ends(names, min(seconds, *(items.length(name) / SAMPLE_RATE for name in names))))
        terms, human = task.loss(network, batch)
        scale = batch["scale"][:, None, None, None]
        terms["si_sdr_db"] = si_sdr(human, scale * batch["clean"])
        terms["si_sdr_error_db"] = si_sdr(scale * batch["error"], scale * batch["clean"])
        right = (human.square().sum((2, 3)) > 0.05 * (scale * batch["clean"]).square().sum((2, 3)))[batch["active"] > 0]
        terms["kept"] = right.float().mean() if right.numel() else torch.tensor(1.0)
        for name, value in terms.items():
            sums[name] = sums.get(name, 0.0) + float(value) * len(names) / len(items.names)
    network.train()
    return sums


def on(device: torch.device, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The batch where the network is."""
    return {name: value.to(device, non_blocking=True) for name, value in batch.items()}


def in_stages(before: Mapping[str, object], steps: int, seed: int, items: int) -> dict[str, object]:
    """What a checkpoint says of its training: step of all stages together, seed, items.

    With --start also each stage's own.

    before: what the network that training started from says of its own, empty where it started from nothing.
    """
    stage = {"steps": steps, "seed": seed, "items": items}
    if not before:
        return {"step": steps, "seed": seed, "items": items}
    first = {"steps": before.get("step"), "seed": before.get("seed"), "items": before.get("items")}
    stages = [*before.get("stages", [first]), stage]
    return {
        "step": sum(s["steps"] or 0 for s in stages),
        "seed": [s["seed"] for s in stages],
        "items": items,
        "stages": stages,
    }
