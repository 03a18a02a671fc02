"""The engines by the names that people type."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.base import ClipEngine, Engine
from edgefilter.errors import UsageError

if TYPE_CHECKING:
    from edgefilter.profile.data import Profile

ENGINES = ("crnn", "ss", "linear", "bypass", "paper-ss", "paper-ss-causal", "paper-crnn")
NEEDS_PROFILE = ("paper-ss", "paper-ss-causal")
HAVE_MODEL = ("crnn", "paper-crnn")
HAVE_LINEAR_STAGE = ("crnn", "ss", "linear")
"""Those whose front is "full": an echo path is adapted before them."""


def create(
    name: str, profile: Profile | None = None, stft: StftConfig = StftConfig(), model: str | Path | None = None
) -> Engine | ClipEngine:
    """Make an engine by name.

    stft: for the engines that work with any; the others have their own. model: the file that a neural engine loads in place of its own.
    Raises UsageError for an unknown name, one that cannot work without a profile or has no use for a model, and ModelError for a
    model file that does not fit.
    """
    if name not in ENGINES:
        raise UsageError(f"unknown engine '{name}': choose one of auto, {', '.join(ENGINES)}")
    if name in NEEDS_PROFILE and profile is None:
        raise UsageError(f"engine {name} needs the robot's calibrated response: give --profile P.npz (made by 'edgefilter calibrate')")
    if model is not None and name not in HAVE_MODEL:
        raise UsageError(f"engine {name} has no network, found the model {model}: leave it out or take one of {', '.join(HAVE_MODEL)}")
    if name == "crnn":
        from edgefilter.engines.crnn import Crnn

        return Crnn(model)
    if name == "paper-crnn":
        from edgefilter.engines.paper_crnn import PaperCrnn

        return PaperCrnn(model)
    if name == "bypass":
        from edgefilter.engines.bypass import Bypass

        return Bypass(stft)
    if name == "linear":
        from edgefilter.engines.linear import Linear

        return Linear(stft)
    if name == "ss":
        from edgefilter.engines.spectral_subtraction import SpectralSubtraction

        return SpectralSubtraction(stft)
    from edgefilter.engines.paper_ss import PAPER_STFT, PaperSpectralSubtraction

    return PaperSpectralSubtraction(profile.response_bins(PAPER_STFT), causal=name == "paper-ss-causal")
