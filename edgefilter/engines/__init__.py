"""The engines by the names that people type."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edgefilter.engines.base import Engine
from edgefilter.errors import UsageError
from edgefilter.stft import StftConfig

if TYPE_CHECKING:
    from edgefilter.profile import Profile

ENGINES = ("ss", "linear", "bypass", "paper-ss", "paper-ss-causal")
NEEDS_PROFILE = ("paper-ss", "paper-ss-causal")


def create(name: str, profile: Profile | None = None, stft: StftConfig = StftConfig()) -> Engine:
    """Make an engine by name; raises UsageError for an unknown name or one that cannot work without a profile.

    stft: for the engines that work with any; the others have their own.
    """
    if name not in ENGINES:
        raise UsageError(f"unknown engine '{name}': choose one of auto, {', '.join(ENGINES)}")
    if name in NEEDS_PROFILE and profile is None:
        raise UsageError(f"engine {name} needs the robot's calibrated response: give --profile P.npz (made by 'edgefilter calibrate')")
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
