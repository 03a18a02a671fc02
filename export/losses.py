"""What training minimises: distances between compressed spectra that serve a recogniser, plus SI-SDR and the activity of the human."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

EPSILON = 1e-8


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of sound_loss, and of the speech head's.

    suppression: an amplitude too small costs 1 + suppression / magnitude times as much as one that is too large, since
    words that were deleted do not come back, while a recogniser gets over some of the robot.
    """

    complex: float = 0.3
    magnitude: float = 0.7
    suppression: float = 6.0
    si_sdr: float = 0.004
    speech: float = 0.1
    compression: float = 0.3


def compressed(spectrum: Tensor, exponent: float) -> tuple[Tensor, Tensor]:
    """Return |S|^exponent (...,) and S |S|^(exponent - 1) (..., 2) of a spectrum S (..., 2)."""
    power = (spectrum * spectrum).sum(-1) + EPSILON
    return power ** (exponent / 2), spectrum * (power ** ((exponent - 1) / 2)).unsqueeze(-1)


def power_law_loss(mask: Tensor, mixture: Tensor, clean: Tensor, exponent: float = 0.3) -> Tensor:
    """Mean squared difference of compressed magnitudes (..., bins), as Wang et al.

    (2019), "VoiceFilter-Lite" and its predecessor, use it.

    The loss of the paper's CRNN: mask and mixture give the estimate's magnitude.
    """
    return ((mask * mixture + EPSILON) ** exponent - (clean + EPSILON) ** exponent).square().mean()


def sound_loss(human: Tensor, clean: Tensor, wanted: Tensor, weights: LossWeights) -> dict[str, Tensor]:
    """Terms of one of the network's sounds and their weighted "total".

    human, the estimate, clean, the true voice, and wanted, that voice with as much of the fan as the estimate should keep:
    (batch, frames, bins, 2), scaled so that speech is near 1. suppression counts once more where the estimate is below what is wanted: words
    that are gone do not come back (Braun & Tashev 2020 compress likewise; the asymmetry follows Wang et al. 2020,
    "VoiceFilter-Lite", eq. (2)).
    """
    magnitude, phased = compressed(human, weights.compression)
    target, target_phased = compressed(wanted, weights.compression)
    missing = torch.relu(target - magnitude)
    terms = {
        "complex": (phased - target_phased).square().sum(-1).mean(),
        "magnitude": (magnitude - target).square().mean(),
        "suppression": missing.square().mean(),
        "si_sdr": -si_sdr(human, clean),
    }
    terms["total"] = sum(getattr(weights, name) * value for name, value in terms.items())
    return terms


def speech_loss(logit: Tensor, active: Tensor, heed: Tensor | None = None) -> Tensor:
    """Cross-entropy of the speech head; logit, active, heed: (batch, frames); heed: what each frame counts, None for all the same."""
    return binary_cross_entropy_with_logits(logit, active, None if heed is None else heed / heed.mean())


def si_sdr(human: Tensor, clean: Tensor) -> Tensor:
    """Mean SI-SDR in dB over the items that hold a human.

    With a root-Hann window at half overlap spectra keep inner products.
    """
    inner = (human * clean).sum((1, 2, 3))
    energy = clean.square().sum((1, 2, 3))
    target = inner.square() / (energy + EPSILON)
    ratio = 10 * torch.log10((target + EPSILON) / (human.square().sum((1, 2, 3)) - target + EPSILON).clamp(min=EPSILON))
    present = (energy > 1e-3).float()
    return (ratio.clamp(-30, 30) * present).sum() / present.sum().clamp(min=1)
