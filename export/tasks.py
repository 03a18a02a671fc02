"""What differs between training the edge network and the paper's: the network, its inputs, its loss, its validation figures."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import ClassVar, Protocol

import torch
from torch import Tensor, nn

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.paper_ss import PAPER_STFT
from edgefilter.errors import UsageError
from export.losses import LossWeights, edge_loss, power_law_loss, si_sdr
from export.network import EdgeConfig, EdgeCrnn, count
from export.paper_network import PaperConfig, PaperCrnn, parameter_count
from export.recogniser_loss import RecogniserLoss

INPUTS = ("error", "mic", "reference", "echo", "noise", "residual")


class Task(Protocol):
    """kind: as the checkpoint names it. stft: of the batches that loss() takes."""

    kind: ClassVar[str]
    stft: StftConfig

    def network(self) -> nn.Module: ...

    def config(self) -> dict[str, object]:
        """Of the network, ready for JSON."""
        ...

    def describe(self, network: nn.Module) -> str: ...

    def loss(self, network: nn.Module, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        """Terms with their "total", and the estimate (batch, frames, bins, 2), scaled by batch["scale"]."""
        ...


class EdgeTask:
    """The causal network on the linear stage's error; half: bfloat16 in the forward pass."""

    kind: ClassVar[str] = "edge"

    def __init__(self, options: argparse.Namespace) -> None:
        shape = {name: getattr(options, name) for name in ("hidden", "norm", "erb")}
        self._config = EdgeConfig(2 * options.hop, options.hop, channels=tuple(options.channels), **shape)
        self.weights = LossWeights(suppression=options.suppression, si_sdr=options.si_sdr)
        self.stft, self.half = self._config.stft, not options.full_precision
        self.recogniser = RecogniserLoss(options.recogniser, self.stft) if options.recogniser else None
        self.recogniser_weight = options.recogniser_weight

    def network(self) -> EdgeCrnn:
        return EdgeCrnn(self._config).to(memory_format=torch.channels_last)

    def config(self) -> dict[str, object]:
        return asdict(self._config)

    def describe(self, network: nn.Module) -> str:
        figures = count(network)
        return (
            f"edge network, {figures['parameters']} parameters,"
            f" {figures['macs_per_frame'] * 16000 / self.stft.hop / 1e6:.0f} MMAC/s"
        )

    def loss(self, network: nn.Module, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        if "residual" not in batch:
            raise UsageError(f"the data was simulated for another transform, expected --hop {self.stft.hop}")
        inputs = [batch[name] for name in INPUTS]
        with torch.autocast(inputs[0].device.type, torch.bfloat16, enabled=self.half and network.training):
            human, logit, _ = network(*inputs, network.initial_state(inputs[0].shape[0]))
        scale = batch["scale"][:, None, None, None]
        human, clean = scale * human.float(), scale * batch["clean"]
        terms = edge_loss(human, logit.float(), clean, batch["active"], self.weights)
        if self.recogniser and network.training:
            terms["recogniser"] = self.recogniser(human, clean)
            terms["total"] = terms["total"] + self.recogniser_weight * terms["recogniser"]
        return terms, human


class PaperTask:
    """Li, Hindriks & Kunneman (2024), section 3.2: a magnitude mask on the microphone, which keeps its phase.

    The linear stage is not used.
    """

    kind: ClassVar[str] = "paper"

    def __init__(self, options: argparse.Namespace) -> None:
        self._config = PaperConfig(batch_norm=options.norm == "batch")
        self.stft = PAPER_STFT

    def network(self) -> PaperCrnn:
        return PaperCrnn(self._config)

    def config(self) -> dict[str, object]:
        return asdict(self._config)

    def describe(self, network: nn.Module) -> str:
        return f"the paper's network, {parameter_count(network)} parameters"

    def loss(self, network: nn.Module, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        scale = batch["scale"][:, None, None, None]
        mask = network(batch["mic"].norm(dim=-1), batch["reference"].norm(dim=-1))
        mic, clean = scale * batch["mic"], scale * batch["clean"]
        loss = power_law_loss(mask, mic.norm(dim=-1), clean.norm(dim=-1))
        human = mask.unsqueeze(-1) * mic
        return {"magnitude": loss, "si_sdr": -si_sdr(human, clean), "total": loss}, human


TASKS: dict[str, type[EdgeTask] | type[PaperTask]] = {"edge": EdgeTask, "paper": PaperTask}
