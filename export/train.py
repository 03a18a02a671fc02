"""Train the edge network, or the paper's, on simulated conversations.

    python -m export.train --data DIR --validation DIR --output RUN [--network edge|paper] [--steps 6000] [--seed 1] [--start RUN/best.pt] [--smoke]

--start takes the weights of a trained network of the same shape, to go on with other data: with --data made by
export/dataset.py --profile, an effect that was found in the field is learned. RUN/last.pt is written every --every
steps (a second call goes on from there), RUN/best.pt holds the averaged weights with the best validation loss;
TensorBoard reads RUN, and RUN/log.jsonl has the same figures.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE
from export.crops import Batches, Items
from export.losses import LossWeights, si_sdr
from export.network import EdgeConfig
from export.onnx_export import load
from export.tasks import TASKS, Task

WARM_UP = 300
"""Steps over which the learning rate rises, at most; a tenth of a short training."""
AVERAGED = 500
"""Steps over which weights are averaged, at most; a short training averages over its last 25th."""
PATIENCE = 12
"""Validations without a better score before training stops."""


@torch.no_grad()
def validate(task: Task, network: nn.Module, items: Items, seconds: float) -> dict[str, float]:
    """Mean loss terms over the last `seconds` of every item, SI-SDR of the estimate and of the linear stage's error, active frames kept."""
    network.eval()
    device = next(network.parameters()).device
    batches = Batches(items, task.stft, 1, seconds, seed=0, augment=False)
    sums: dict[str, float] = {}
    for at in range(0, len(items.names), 8):
        names = items.names[at : at + 8]
        batch = batches.spectra(
            [items.crop(name, items.length(name) - batches.samples, batches.samples) for name in names]
        )
        batch = on(device, batch)
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


def on(device: torch.device, batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """The batch where the network is."""
    return {name: value.to(device, non_blocking=True) for name, value in batch.items()}


def train(options: argparse.Namespace) -> Path:
    """Run until --steps or until validation stops getting better, on a GPU where there is one.

    Returns the best checkpoint.
    """
    torch.manual_seed(options.seed)
    torch.set_num_threads(options.threads)
    options.output.mkdir(parents=True, exist_ok=True)
    task = TASKS[options.network](options)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = task.network().to(device)
    before: Mapping[str, object] = {}
    if options.start:
        start = load(options.start)
        found, wanted, before = start.network.config, network.config, start.training
        if found != wanted:
            remedy = "give the same --hop, --channels, --hidden and --norm"
            raise UsageError(f"{options.start} holds a network of {found}, expected {wanted}: {remedy}")
        network.load_state_dict(start.network.state_dict())
    average = {name: value.clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), lr=options.rate, weight_decay=1e-2, betas=(0.9, 0.98))
    items, held_out = Items(options.data), Items(options.validation)
    first, best, since = 0, -math.inf, 0
    last = options.output / "last.pt"
    if last.exists():
        saved = torch.load(last, map_location=device, weights_only=True)
        network.load_state_dict(saved["network"])
        optimiser.load_state_dict(saved["optimiser"])
        average, first, best, since = saved["average"], saved["step"], saved["best"], saved["since"]
    batches = Batches(items, task.stft, options.batch, options.seconds, options.seed + first)
    print(f"{task.describe(network)}; {len(items.names)} items, from step {first}")
    began = time.time()
    with SummaryWriter(options.output) as board, (options.output / "log.jsonl").open("a", encoding="utf-8") as log:
        for step in (progress := tqdm(range(first, options.steps), initial=first, total=options.steps, unit="step")):
            for group in optimiser.param_groups:
                group["lr"] = (
                    options.rate
                    * min(1.0, (step + 1) / min(WARM_UP, options.steps / 10))
                    * (0.5 + 0.5 * math.cos(math.pi * step / options.steps))
                    + 1e-6
                )
            terms, _ = task.loss(network, on(device, batches.draw()))
            optimiser.zero_grad(set_to_none=True)
            terms["total"].backward()
            shown = {name: float(value.detach()) for name, value in terms.items()}
            norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            if torch.isfinite(norm):
                optimiser.step()
            keep = min(1 - 1 / min(AVERAGED, max(2.0, options.steps / 25)), (step + 1) / (step + 10))
            for name, value in network.state_dict().items():
                if value.dtype.is_floating_point:
                    average[name].mul_(keep).add_(value, alpha=1 - keep)
                else:
                    average[name].copy_(value)
            progress.set_postfix(loss=f"{shown['total']:.4f}", si_sdr=f"{-shown['si_sdr']:.1f}")
            board.add_scalar("train/total", shown["total"], step)
            if (step + 1) % options.every and step + 1 < options.steps:
                continue
            averaged = task.network().to(device)
            averaged.load_state_dict(average)
            figures = validate(task, averaged, held_out, min(8.0, 2 * options.seconds))
            score = -figures["total"]
            since = 0 if score > best else since + 1
            said = in_stages(before, step + 1, options.seed, len(items.names))
            state = {"kind": task.kind, "config": task.config(), "network": average, "figures": figures, **said}
            if score > best:
                best = score
                torch.save(state, options.output / "best.pt")
            torch.save(
                {
                    "network": network.state_dict(),
                    "optimiser": optimiser.state_dict(),
                    "average": average,
                    "step": step + 1,
                    "best": best,
                    "since": since,
                },
                last,
            )
            for name, value in figures.items():
                board.add_scalar(f"validation/{name}", value, step + 1)
            log.write(
                json.dumps(
                    {
                        "step": step + 1,
                        "seconds": round(time.time() - began),
                        "items": len(items.names),
                        **{k: round(v, 5) for k, v in figures.items()},
                    }
                )
                + "\n"
            )
            log.flush()
            tqdm.write(f"step {step + 1}: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()))
            items.refresh()
            if since >= PATIENCE:
                print(f"stopped: {PATIENCE} validations without a better score")
                break
    return options.output / "best.pt"


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


def smoke(options: argparse.Namespace) -> None:
    """A few items of coloured noise instead of speech in --data, so that the whole of train() runs within seconds."""
    rng = np.random.default_rng(0)
    for folder in (options.data, options.validation):
        folder.mkdir(parents=True, exist_ok=True)
        for index in range(2):
            human, robot = (rng.standard_normal(3 * SAMPLE_RATE).cumsum() % 7 - 3 for _ in range(2))
            signals = {"mic": human + 9 * robot, "error": human + robot, "reference": 9 * robot, "clean": human}
            packed = {name: np.round(1000 * samples).astype(np.int16) for name, samples in signals.items()}
            np.savez(folder / f"{index:05d}.npz", scale=np.float32(0.9), reference_scale=np.float32(0.9), **packed)
    options.steps, options.every, options.batch, options.seconds = 4, 2, 2, 1.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR")
    parser.add_argument("--validation", type=Path, required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--network", choices=tuple(TASKS), default="edge")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--every", type=int, default=500, help="steps between validations")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=4.0, help="of a crop")
    parser.add_argument("--rate", type=float, default=1.5e-3, help="learning rate at the start")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hop", type=int, default=256)
    parser.add_argument("--channels", type=int, nargs=4, default=EdgeConfig.channels)
    parser.add_argument("--hidden", type=int, default=EdgeConfig.hidden)
    parser.add_argument("--norm", choices=("layer", "batch", "none"), default="layer")
    parser.add_argument("--suppression", type=float, default=LossWeights.suppression)
    parser.add_argument("--si-sdr", type=float, default=LossWeights.si_sdr)
    parser.add_argument("--start", type=Path, metavar="CHECKPOINT", help="weights to begin with")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--full-precision", action="store_true", help="float32 instead of bfloat16 in the forward pass")
    parser.add_argument(
        "--smoke", action="store_true", help="make a few seconds of data in --data and --validation and take four steps"
    )
    options = parser.parse_args()
    try:
        if options.smoke:
            smoke(options)
        train(options)
    except (EdgefilterError, OSError) as error:
        print(f"train: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
