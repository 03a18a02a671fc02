"""The training loop of VoiceFilter: steps, averaged weights, validation, a checkpoint to go on from."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor, nn
from tqdm import tqdm

from edgefilter.errors import UsageError
from export.losses import power_law_loss, si_sdr
from export.onnx_export import Trained
from export.trainer import Plan, write_whole
from export.voicefilter_mixtures import Mixtures
from export.voicefilter_network import COMPRESSION, VoiceFilter, VoiceFilterConfig

HELD_OUT_S = 8.0
"""Seconds of each validation item, its last."""


def loss(network: nn.Module, batch: Mapping[str, Tensor], half: bool = False) -> tuple[Tensor, Tensor]:
    """Difference of power-law compressed magnitudes, and the estimate's spectrum (batch, frames, bins, 2), scaled as the batch is."""
    magnitude = batch["mic"].norm(dim=-1)
    # a processor without AVX-512 has no such LSTM
    with torch.autocast("cpu", torch.bfloat16, enabled=half and torch.ops.mkldnn._is_mkldnn_bf16_supported()):
        mask = network(magnitude, batch["d_vector"])
    difference = power_law_loss(mask.float(), magnitude, batch["clean"].norm(dim=-1), COMPRESSION)
    return difference, mask.float().unsqueeze(-1) * batch["mic"]


@torch.no_grad()
def validate(network: nn.Module, held_out: Mixtures, seconds: float = HELD_OUT_S) -> dict[str, float]:
    """Mean loss over the items whose human is told, and mean SI-SDR in dB: of the estimate, the same told another human, the microphone.

    An SI-SDR counts as 30 dB at most and -30 dB at least.
    """
    network.eval()
    rows = []
    for item in held_out.told:
        batch = held_out.whole(item, seconds)
        difference, human = loss(network, batch)
        _, other = loss(network, held_out.whole(item, seconds, held_out.somebody_else(item)))
        reached = [si_sdr(estimate, batch["clean"]) for estimate in (human, other, batch["mic"])]
        rows.append([float(value) for value in (difference, *reached)])
    network.train()
    names = ("loss", "si_sdr_db", "si_sdr_other_db", "si_sdr_mic_db")
    return dict(zip(names, torch.tensor(rows).mean(0).tolist(), strict=True)) | {"held_out": len(rows)}


class VoiceFilterTrainer:
    """Trains into a folder: last.pt to go on from, best.pt by validation loss, log.jsonl.

    half: bfloat16 in the forward pass.
    """

    def __init__(self, config: VoiceFilterConfig, plan: Plan, output: Path, half: bool = True) -> None:
        self.plan, self.output, self.half = plan, output, half
        torch.manual_seed(plan.seed)
        self.network = VoiceFilter(config)
        self.average = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=plan.rate, weight_decay=1e-2)
        self.step, self.best, self.seconds = 0, math.inf, 0.0
        self._resume()

    def run(self, mixtures: Mixtures, held_out: Mixtures, batch: int, seconds: float) -> None:
        """Train until the plan is done. batch: crops a step, seconds: of each."""
        if self.plan.done_at(self.step, self.seconds) >= 1.0:
            return
        began = time.perf_counter() - self.seconds
        with tqdm(range(self.step, self.plan.steps), initial=self.step, total=self.plan.steps) as progress:
            for step in progress:
                progress.set_postfix(loss=f"{self._one(mixtures.draw(step, batch, seconds)):.4f}")
                self.step, self.seconds = step + 1, time.perf_counter() - began
                over = self.plan.done_at(self.step, self.seconds) >= 1.0
                if over or self.step % self.plan.every == 0:
                    self._validate(held_out, len(mixtures.items))
                if over:
                    break

    def _one(self, batch: Mapping[str, Tensor]) -> float:
        for group in self.optimiser.param_groups:
            group["lr"] = self.plan.rate_at(self.step, self.seconds)
        difference, _ = loss(self.network, batch, self.half)
        self.optimiser.zero_grad(set_to_none=True)
        difference.backward()
        if torch.isfinite(nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)):
            self.optimiser.step()
        keep = self.plan.kept_at(self.step)
        for name, value in self.network.state_dict().items():
            if value.dtype.is_floating_point:
                self.average[name].mul_(keep).add_(value, alpha=1 - keep)
            else:
                self.average[name].copy_(value)
        return float(difference.detach())

    def _validate(self, held_out: Mixtures, items: int) -> None:
        """Validate the averaged weights and write them, as the best ones too where they are."""
        averaged = VoiceFilter(self.network.config)
        averaged.load_state_dict(self.average)
        figures = validate(averaged, held_out)
        state = {
            "config": asdict(self.network.config),
            "network": self.average,
            "figures": figures,
            "training": {"step": self.step, "seed": self.plan.seed, "items": items, "seconds": round(self.seconds)},
        }
        if figures["loss"] < self.best:
            self.best = figures["loss"]
            write_whole(state, self.output / "best.pt")
        here = {"step": self.step, "best": self.best, "seconds": self.seconds}
        here |= {"running": self.network.state_dict(), "optimiser": self.optimiser.state_dict()}
        write_whole(state | {"resume": here}, self.output / "last.pt")
        line = state["training"] | {name: round(value, 5) for name, value in figures.items()}
        with (self.output / "log.jsonl").open("a", encoding="utf-8") as log:
            log.write(json.dumps(line) + "\n")
        tqdm.write(f"step {self.step}: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()))

    def _resume(self) -> None:
        """Go on where a training into the same folder ended; raises UsageError where that was of another shape."""
        last = self.output / "last.pt"
        if not last.exists():
            return
        saved = torch.load(last, map_location="cpu", weights_only=True)
        found, wanted = VoiceFilterConfig(**saved["config"]), self.network.config
        if found != wanted:
            raise UsageError(
                f"{last} holds a network of {found}, expected {wanted}: give the same widths or another folder"
            )
        here, self.average = saved["resume"], saved["network"]
        self.network.load_state_dict(here["running"])
        self.optimiser.load_state_dict(here["optimiser"])
        self.step, self.best, self.seconds = here["step"], here["best"], here["seconds"]


def load(checkpoint: Path) -> Trained:
    """The network of best.pt or last.pt, in evaluation mode, with what is known of its training."""
    found = torch.load(checkpoint, map_location="cpu", weights_only=True)
    network = VoiceFilter(VoiceFilterConfig(**found["config"]))
    network.load_state_dict(found["network"])
    return Trained(network.eval(), found["training"], found["figures"])
