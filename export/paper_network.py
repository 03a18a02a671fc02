"""The source paper's network, layer by layer as in its Table 1: two convolutional branches, one BLSTM, two dense layers, a soft mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from edgefilter.engines.paper_ss import PAPER_STFT

KERNELS = ((1, 7), (7, 1), (5, 5), (5, 5), (5, 5), (5, 5), (5, 5), (1, 1))
"""Width of each convolution, frames x bins."""
DILATIONS = (1, 1, 1, 2, 4, 8, 16, 1)
"""Dilation of each convolution over frames; over bins it is 1."""


@dataclass(frozen=True)
class PaperConfig:
    """Sizes of the paper's Table 1, or of a narrower network of the same shape.

    bins: frequencies of the input and of the mask. filters: of each of the eight convolutions of a branch. lstm: units in
    each direction. hidden: units of the first dense layer. batch_norm: batch normalisation behind each convolution.
    """

    bins: int = PAPER_STFT.bins
    filters: tuple[int, ...] = (64, 64, 64, 64, 64, 64, 64, 8)
    lstm: int = 400
    hidden: int = 600
    batch_norm: bool = False


class PaperCrnn(nn.Module):
    """CRNN of Li, Hindriks & Kunneman 2024, section 3.3 and Table 1.

    The paper has batch normalisation behind each convolution and then finds that it harms where the interferer is much
    louder; so here it is an option and off. The paper leaves open, and this implementation takes: zero padding, so that
    each layer keeps its size; 400 BLSTM units in each direction (VoiceFilter's reading of the same table); magnitudes
    as they are, not in decibels; and He's initialisation of the convolutions (He et al. 2015, eq. 10), since without
    batch normalisation torch's default lets the signal fade away over eight layers.
    """

    def __init__(self, config: PaperConfig = PaperConfig()) -> None:
        super().__init__()
        self.config = config
        self.mixture = convolutions(config.filters, config.batch_norm)
        self.reference = convolutions(config.filters, config.batch_norm)
        self.blstm = nn.LSTM(2 * config.filters[-1] * config.bins, config.lstm, batch_first=True, bidirectional=True)
        self.dense = nn.Sequential(
            nn.Linear(2 * config.lstm, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.bins), nn.Sigmoid()
        )

    @property
    def last(self) -> nn.Linear:
        """The layer whose sigmoid is the mask."""
        return self.dense[2]

    def forward(self, mic_magnitude: Tensor, reference_magnitude: Tensor) -> Tensor:
        """Mask in 0-1 for the mixture's magnitude, from both magnitudes, (batch, frames, bins) each."""
        branches = (self.mixture(mic_magnitude.unsqueeze(1)), self.reference(reference_magnitude.unsqueeze(1)))
        features = torch.cat(branches, dim=1).permute(0, 2, 1, 3).flatten(2)
        recurrent, _ = self.blstm(features)
        return self.dense(torch.relu(recurrent))


def convolutions(filters: Sequence[int], batch_norm: bool) -> nn.Sequential:
    """The eight convolutions of one input, (batch, 1, frames, bins) to (batch, last of filters, frames, bins)."""
    layers: list[nn.Module] = []
    channels = 1
    for width, kernel, dilation in zip(filters, KERNELS, DILATIONS, strict=True):
        same = (dilation * (kernel[0] // 2), kernel[1] // 2)
        convolution = nn.Conv2d(channels, width, kernel, padding=same, dilation=(dilation, 1))
        nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        nn.init.zeros_(convolution.bias)
        layers.append(convolution)
        if batch_norm:
            layers.append(nn.BatchNorm2d(width))
        layers.append(nn.ReLU())
        channels = width
    return nn.Sequential(*layers)


def parameter_count(network: nn.Module) -> int:
    """Number of trained values."""
    return sum(parameter.numel() for parameter in network.parameters())


def macs_per_frame(network: PaperCrnn) -> int:
    """Multiply-accumulates of convolutions, recurrent and dense layers for one frame."""
    total = 0
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            total += module.weight.numel() * network.config.bins
        elif isinstance(module, nn.LSTM | nn.Linear):
            total += sum(weight.numel() for name, weight in module.named_parameters() if name.startswith("weight"))
    return total
