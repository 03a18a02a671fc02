"""The Wiener mask of 'ss' as the network's prior: what edgefilter/engines/spectral_subtraction.py computes, on tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from edgefilter.engines.spectral_subtraction import FLOOR, MEMORY

SILENCE = 1e-12
LEAST, MOST = 1e-3, 0.995
"""Bounds on the wanted part of the power, -60 and -0.02 dB: beyond, a logit says nothing more."""
DECADES = 2.0
"""Bound on the logarithm of the error's magnitude over what is expected, 40 dB."""


def ratios(observed: Tensor, unwanted: Tensor, answered: Tensor) -> tuple[Tensor, Tensor]:
    """The wanted part of each bin's power, LEAST to MOST, (batch, frames, bins), and the power of the last answer (batch, bins).

    observed, unwanted: |error|^2 and what of it is expected to be fan and residual echo, (batch, frames, bins).
    answered: power of the answer before the first frame.
    """
    found = []
    for now, known in zip(observed.unbind(1), (unwanted + SILENCE).unbind(1)):
        ratio, answered = step(now, known, answered)
        found.append(ratio)
    return torch.stack(found, 1), answered


def step(observed: Tensor, unwanted: Tensor, answered: Tensor) -> tuple[Tensor, Tensor]:
    """One frame of the same, unwanted above zero."""
    wanted = MEMORY * answered + (1.0 - MEMORY) * torch.relu(observed - unwanted)
    ratio = wanted / (wanted + unwanted)
    return ratio.clamp(LEAST, MOST), ratio.clamp(min=FLOOR).square() * observed


def gain(ratio: Tensor) -> Tensor:
    """What 'ss' multiplies the error with."""
    return ratio.clamp(min=FLOOR)


def features(observed: Tensor, noise: Tensor, residual: Tensor, ratio: Tensor, along: int = -1) -> Tensor:
    """What the network is told of it: the error over fan and over residual echo, and the logit of ratio; stacked along a new dimension."""
    level = torch.log10(observed + SILENCE)
    over = [(0.5 * (level - torch.log10(power + SILENCE))).clamp(-DECADES, DECADES) for power in (noise, residual)]
    return torch.stack([*over, 0.25 * torch.log(ratio / (1 - ratio))], along)
