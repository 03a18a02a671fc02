"""What differs between training the edge network and the paper's: the network, its inputs, its loss, its validation figures."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor, nn

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.paper_ss import PAPER_STFT
from edgefilter.errors import UsageError
from export.losses import LossWeights, power_law_loss, si_sdr, sound_loss, speech_loss
from export.network import EdgeConfig, EdgeCrnn, count
from export.onnx_export import load
from export.paper_network import DILATIONS, PaperConfig, PaperCrnn, parameter_count
from export.recogniser_loss import RecogniserLoss

INPUTS = ("error", "mic", "reference", "echo", "noise", "residual")
FOREIGN = {"edge": ("filters", "lstm"), "paper": ("channels", "erb", "recogniser", "like")}
"""Options of the other network, by kind; None where they were not given."""

FIRST_MASK = 10 ** (-25 / 20)
"""Of the paper's network before training: the paper's humans are 25 dB below the robot (section 4)."""


class Task(Protocol):
    """What is trained, and on which loss.

    kind: as the checkpoint names it. remedy: against another shape than asked for. stft: of the batches that loss() takes.
    """

    kind: ClassVar[str]
    remedy: ClassVar[str]
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
    """The causal network on the linear stage's error; half: bfloat16 in the forward pass.

    before: configuration of the training that goes on, for what the options leave open. Raises UsageError for an option
    of another network. With --like the sounds of a trained network are the target of both, so that only the speech head learns anything
    new, with all of the network ("learning without forgetting", Li & Hoiem 2016).
    """

    kind: ClassVar[str] = "edge"
    remedy: ClassVar[str] = "give the same --hop, --channels, --hidden and --norm"

    def __init__(self, options: argparse.Namespace, before: Mapping[str, object] = MappingProxyType({})) -> None:
        _refuse_foreign(options, self.kind)
        names = ("channels", "hidden", "norm", "erb")
        shape = {name: before[name] for name in names if name in before} | _given(options, names)
        if "channels" in shape:
            shape["channels"] = tuple(shape["channels"])
        self._config = EdgeConfig(2 * options.hop, options.hop, **shape)
        self.weights = LossWeights(suppression=options.suppression, si_sdr=options.si_sdr)
        self.stft, self.half = self._config.stft, not options.full_precision
        self.recogniser = RecogniserLoss(options.recogniser, self.stft, half=self.half) if options.recogniser else None
        for name, share in (("--fan-kept", options.fan_kept), ("--fan-recognised", options.fan_recognised)):
            if not 0.0 <= share <= 1.0:
                raise UsageError(f"{name} is {share:g}, expected 0 to 1")
        self.fans_kept = options.fan_kept, options.fan_recognised
        self.recogniser_weight, self.second_alone = options.recogniser_weight, options.second_alone
        self.like = self._example(options.like) if options.like else None

    def _example(self, checkpoint: Path) -> EdgeCrnn:
        """The trained network of --like, which learns nothing. Raises UsageError where it takes no such spectra, ModelError where there is none."""
        network = load(checkpoint).network
        if not (isinstance(network, EdgeCrnn) and network.config.stft == self.stft):
            raise UsageError(f"--like {checkpoint} holds a network of another --network or --hop than this training's")
        return network.eval().requires_grad_(False)

    def network(self) -> EdgeCrnn:
        network = EdgeCrnn(self._config).to(memory_format=torch.channels_last)
        for name, weight in network.named_parameters():
            weight.requires_grad_(not self.second_alone or name.startswith("recognise."))
        return network

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
            raise UsageError(
                f"the data was simulated with another --hop than {self.stft.hop}: give that one, or simulate it anew"
            )
        inputs = [batch[name] for name in INPUTS]
        with torch.autocast(inputs[0].device.type, torch.bfloat16, enabled=self.half and network.training):
            *sounds, logit, _ = network(*inputs, network.initial_state(inputs[0].shape[0]))
        scale = batch["scale"][:, None, None, None]
        clean = scale * batch["clean"]
        listen, recognise = (scale * sound.float() for sound in sounds)
        terms, second = (
            sound_loss(sound, *targets, self.weights)
            for sound, targets in zip((listen, recognise), self._targets(batch, scale, clean), strict=True)
        )
        terms["speech"] = speech_loss(logit.float(), batch["active"], batch["heed"])
        terms["recognise"] = second["total"]
        terms["total"] = terms["total"] + self.weights.speech * terms["speech"] + terms["recognise"]
        if self.recogniser and network.training:
            terms["recogniser"] = self.recogniser(recognise, clean)
            terms["total"] = terms["total"] + self.recogniser_weight * terms["recogniser"]
        return terms, listen

    def _targets(self, batch: Mapping[str, Tensor], scale: Tensor, clean: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Of each sound the clean voice and what the network should give; with --like both are what the network that it names gives."""
        if self.like is None:
            return [(clean, clean + kept * (scale * batch["fan"])) for kept in self.fans_kept]
        inputs, like = [batch[name] for name in INPUTS], self.like.to(clean.device)
        with torch.no_grad():
            *sounds, _, _ = like(*inputs, like.initial_state(clean.shape[0]))
        return [(scale * sound, scale * sound) for sound in sounds]


class PaperTask:
    """Li, Hindriks & Kunneman (2024), section 3.2: a magnitude mask on the microphone, which keeps its phase.

    The linear stage is not used. half: bfloat16 in the forward pass. before: configuration of the training that goes on,
    for what the options leave open; all that is open then is Table 1's. Raises UsageError for an option of another
    network, for other than one or two numbers of filters, and for a size below 1.
    """

    kind: ClassVar[str] = "paper"
    remedy: ClassVar[str] = "give the same --filters, --lstm, --hidden and --norm, or none of them"

    def __init__(self, options: argparse.Namespace, before: Mapping[str, object] = MappingProxyType({})) -> None:
        _refuse_foreign(options, self.kind)
        shape = dict(before) | _given(options, ("lstm", "hidden"))
        if options.filters is not None:
            shape["filters"] = filters_of(options.filters)
        if options.norm is not None:
            shape["batch_norm"] = options.norm == "batch"
        for name in ("lstm", "hidden"):
            if shape.get(name, 1) < 1:
                raise UsageError(f"--{name} is {shape[name]}, expected 1 or more")
        self._config = PaperConfig(**shape)
        self.stft, self.half = PAPER_STFT, not options.full_precision

    def network(self) -> PaperCrnn:
        """Its mask begins at FIRST_MASK, where training from one half would first go for hundreds of steps."""
        network = PaperCrnn(self._config).to(memory_format=torch.channels_last)
        nn.init.constant_(network.last.bias, math.log(FIRST_MASK / (1 - FIRST_MASK)))
        return network

    def config(self) -> dict[str, object]:
        return asdict(self._config)

    def describe(self, network: nn.Module) -> str:
        return f"the paper's network, {parameter_count(network)} parameters"

    def loss(self, network: nn.Module, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        scale = batch["scale"][:, None, None, None]
        magnitudes = batch["mic"].norm(dim=-1), batch["reference"].norm(dim=-1)
        with torch.autocast(magnitudes[0].device.type, torch.bfloat16, enabled=self.half and network.training):
            mask = network(*magnitudes).float()
        mic, clean = scale * batch["mic"], scale * batch["clean"]
        loss = power_law_loss(mask, mic.norm(dim=-1), clean.norm(dim=-1))
        human = mask.unsqueeze(-1) * mic
        return {"magnitude": loss, "si_sdr": -si_sdr(human, clean), "total": loss}, human


def filters_of(each: Sequence[int]) -> tuple[int, ...]:
    """Filters of the eight convolutions of a branch, from those of the first seven and, as a second number, of the last.

    Of one number the last gets an eighth as in the paper's Table 1, 1 at least. Raises UsageError for other than one or two
    numbers, and for one below 1.
    """
    if len(each) not in (1, 2):
        raise UsageError(
            f"--filters has {len(each)} numbers, expected one, or two of which the second is the last layer's"
        )
    if min(each) < 1:
        raise UsageError(f"--filters has {min(each)}, expected 1 or more")
    last = each[1] if len(each) == 2 else max(1, each[0] // 8)
    return (each[0],) * (len(DILATIONS) - 1) + (last,)


def _given(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Those of these options that the command line names."""
    return {name: value for name in names if (value := getattr(options, name, None)) is not None}


def _refuse_foreign(options: argparse.Namespace, kind: str) -> None:
    for name in _given(options, FOREIGN[kind]):
        other = next(each for each in FOREIGN if each != kind)
        raise UsageError(f"--{name} is of --network {other}, and this is --network {kind}: leave it out")
    if kind == PaperTask.kind and options.norm == "layer":
        raise UsageError("--norm is layer, expected batch or none for --network paper")


TASKS: dict[str, type[EdgeTask] | type[PaperTask]] = {"edge": EdgeTask, "paper": PaperTask}
