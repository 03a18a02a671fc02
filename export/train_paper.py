"""Train the source paper's network on simulated conversations, on a GPU where there is one.

    python -m export.dataset --recipe paper --humans DIR --robots DIR --output DATA --count 7200
    python -m export.train_paper --data DATA --validation DIR --output RUN [--steps 20000] [--seed 1] [--batch-norm] [--smoke]

RUN/last.pt is written every --every steps (a second call goes on from there), RUN/best.pt holds the weights with the least validation
loss; TensorBoard reads RUN. Then: python -m export.onnx_export RUN/best.pt --output paper_crnn.onnx --int8
"""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from edgefilter.engines.paper_ss import PAPER_STFT
from export.crops import Batches, Items
from export.losses import power_law_loss
from export.paper_network import PaperConfig, PaperCrnn
from export.train import smoke

PATIENCE = 8
"""Validations without a lower loss before training stops."""


def magnitude(spectrum: Tensor) -> Tensor:
    """(..., 2) to (...)."""
    return torch.linalg.vector_norm(spectrum, dim=-1)


def loss_of(network: PaperCrnn, batch: dict[str, Tensor], device: torch.device) -> Tensor:
    """The paper's loss of one batch: compressed magnitudes of the masked mixture against those of the human."""
    mic, reference, clean = (magnitude(batch[name].to(device, non_blocking=True)) for name in ("mic", "reference", "clean"))
    return power_law_loss(network(mic, reference), mic, clean)


@torch.no_grad()
def validate(network: PaperCrnn, items: Items, seconds: float, device: torch.device) -> float:
    """Mean loss over the last `seconds` of every item."""
    network.eval()
    batches = Batches(items, PAPER_STFT, 1, seconds, seed=0, augment=False)
    losses = []
    for name in items.names:
        batch = batches.spectra([items.crop(name, items.length(name) - batches.samples, batches.samples)])
        losses.append(float(loss_of(network, batch, device)))
    network.train()
    return sum(losses) / len(losses)


def train(options: argparse.Namespace) -> Path:
    """Run until --steps or until validation stops getting better; returns the best checkpoint."""
    torch.manual_seed(options.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    options.output.mkdir(parents=True, exist_ok=True)
    config = PaperConfig(filters=(*[options.filters] * 7, min(8, options.filters)), lstm=options.lstm, hidden=options.hidden, batch_norm=options.batch_norm)
    network = PaperCrnn(config).to(device)
    optimiser = torch.optim.Adam(network.parameters(), lr=options.rate)
    items, held_out = Items(options.data), Items(options.validation)
    step, best, since = 0, math.inf, 0
    last = options.output / "last.pt"
    if last.exists():
        saved = torch.load(last, map_location=device, weights_only=True)
        network.load_state_dict(saved["network"])
        optimiser.load_state_dict(saved["optimiser"])
        step, best, since = saved["step"], saved["best"], saved["since"]
    batches = Batches(items, PAPER_STFT, options.batch, options.seconds, options.seed + step, augment=False)
    print(f"{config} on {len(items.names)} items, from step {step}, on {device}")
    with SummaryWriter(options.output) as board:
        for step in (progress := tqdm(range(step, options.steps), initial=step, total=options.steps, unit="step")):
            loss = loss_of(network, batches.draw(), device)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            progress.set_postfix(loss=f"{loss.item():.4f}")
            board.add_scalar("train/loss", loss.item(), step)
            if (step + 1) % options.every and step + 1 < options.steps:
                continue
            found = validate(network, held_out, options.seconds, device)
            board.add_scalar("validation/loss", found, step + 1)
            since = 0 if found < best else since + 1
            if found < best:
                best = found
                about = {"step": step + 1, "seed": options.seed, "items": len(items.names), "figures": {"validation_loss": found}}
                torch.save({"kind": "paper", "config": asdict(config), "network": network.state_dict(), **about}, options.output / "best.pt")
            state = {"network": network.state_dict(), "optimiser": optimiser.state_dict(), "step": step + 1, "best": best, "since": since}
            torch.save(state, last)
            tqdm.write(f"step {step + 1}: validation loss {found:.4g}")
            if since >= PATIENCE:
                print(f"stopped: {PATIENCE} validations without a lower loss")
                break
    return options.output / "best.pt"


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR")
    parser.add_argument("--validation", type=Path, required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--steps", type=int, default=20000)
    parser.add_argument("--every", type=int, default=500, help="steps between validations")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=5.0, help="of a segment")
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--filters", type=int, default=64, help="of each convolution; the last has at most 8")
    parser.add_argument("--lstm", type=int, default=PaperConfig.lstm)
    parser.add_argument("--hidden", type=int, default=PaperConfig.hidden)
    parser.add_argument("--batch-norm", action="store_true", help="as in the paper, which then finds it harmful")
    parser.add_argument("--smoke", action="store_true", help="make a few seconds of data in --data and --validation and take four steps")
    options = parser.parse_args(argv)
    if options.smoke:
        smoke(options)
    train(options)


if __name__ == "__main__":
    main()
