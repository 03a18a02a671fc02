"""What the training of VoiceFilter has of its own: its task, what its batches are drawn from, its validation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import ClassVar

import torch
from torch import Tensor, nn

from export.losses import power_law_loss, si_sdr
from export.paper_network import parameter_count
from export.trainer import HELD_OUT_S, Trainer
from export.voicefilter_mixtures import Mixtures
from export.voicefilter_network import COMPRESSION, VoiceFilter, VoiceFilterConfig


class VoiceFilterTask:
    """A soft mask for the told voice on the microphone, which keeps its phase. half: bfloat16 in the forward pass."""

    kind: ClassVar[str] = "voicefilter"
    remedy: ClassVar[str] = "give the same widths"

    def __init__(self, config: VoiceFilterConfig, half: bool = True) -> None:
        self._config, self.stft = config, config.stft
        # torch has a bfloat16 LSTM only for processors with AVX-512
        self._half = half and torch.ops.mkldnn._is_mkldnn_bf16_supported()

    def network(self) -> VoiceFilter:
        return VoiceFilter(self._config)

    def config(self) -> dict[str, object]:
        return asdict(self._config)

    def describe(self, network: nn.Module) -> str:
        return f"VoiceFilter, {parameter_count(network)} parameters"

    def loss(self, network: nn.Module, batch: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        """Loss of power-law compressed magnitudes ("total") and SI-SDR, and the estimate at the batch's level."""
        magnitude = batch["mic"].norm(dim=-1)
        with torch.autocast("cpu", torch.bfloat16, enabled=self._half and network.training):
            mask = network(magnitude, batch["d_vector"]).float()
        human = mask.unsqueeze(-1) * batch["mic"]
        difference = power_law_loss(mask, magnitude, batch["clean"].norm(dim=-1), COMPRESSION)
        return {"si_sdr": -si_sdr(human, batch["clean"]), "total": difference}, human


class VoiceFilterTrainer(Trainer):
    """Trains VoiceFilter on Mixtures in place of Items."""

    def _draws(self, items: Mixtures) -> Callable[[int], dict[str, Tensor]]:
        return lambda step: items.draw(step, *self.shape.of(step))

    def _figures(self, network: nn.Module, held_out: Mixtures) -> dict[str, float]:
        return validate(self.task, network, held_out)


@torch.no_grad()
def validate(task: VoiceFilterTask, network: nn.Module, held_out: Mixtures) -> dict[str, float]:
    """Mean loss, and mean SI-SDR in dB with the right d-vector, with that of another human and of the microphone, over items with a d-vector.

    An SI-SDR counts as 30 dB at most and -30 dB at least.
    """
    network.eval()
    rows = []
    for item in held_out.told:
        batch = held_out.whole(item, HELD_OUT_S)
        terms, human = task.loss(network, batch)
        _, other = task.loss(network, held_out.whole(item, HELD_OUT_S, held_out.somebody_else(item)))
        reached = [si_sdr(estimate, batch["clean"]) for estimate in (human, other, batch["mic"])]
        rows.append([float(value) for value in (terms["total"], *reached)])
    network.train()
    names = ("total", "si_sdr_db", "si_sdr_other_db", "si_sdr_mic_db")
    return dict(zip(names, torch.tensor(rows).mean(0).tolist(), strict=True)) | {"held_out": len(rows)}
