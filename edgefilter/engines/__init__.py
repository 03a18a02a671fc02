"""The engines by the names that people type."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.base import ClipEngine, Engine
from edgefilter.errors import UsageError

if TYPE_CHECKING:
    from edgefilter.profile.data import Profile


@dataclass(frozen=True, slots=True)
class Entry:
    """One engine of the catalogue.

    module: its file in this folder, loaded when the engine is asked for and not before: one of them loads onnxruntime.
    factory: the class or function in that file that makes it. takes: which arguments the factory has of these three: the STFT
    to work with, the path of a network in place of the engine's own, the robot's profile. automatic: whether "auto" may choose
    it. linear_stage: whether the adaptive canceller runs before it.
    """

    module: str
    factory: str
    takes: tuple[Literal["stft", "model", "profile"], ...]
    automatic: bool = False
    linear_stage: bool = False


CATALOGUE = {
    "crnn": Entry("crnn", "Crnn", ("model", "profile"), automatic=True, linear_stage=True),
    "ss": Entry("spectral_subtraction", "SpectralSubtraction", ("stft",), automatic=True, linear_stage=True),
    "linear": Entry("linear", "Linear", ("stft",), automatic=True, linear_stage=True),
    "bypass": Entry("linear", "Bypass", ("stft",)),
    "paper-ss": Entry("paper_ss", "paper_ss", ("profile",)),
    "paper-ss-causal": Entry("paper_ss", "paper_ss_causal", ("profile",)),
    "paper-crnn": Entry("paper_crnn", "PaperCrnn", ("model",)),
}
"""Best first: that is the order in which "auto" tries them."""
ENGINES = tuple(CATALOGUE)
NEEDS_PROFILE = tuple(name for name, entry in CATALOGUE.items() if entry.takes == ("profile",))
HAVE_MODEL = tuple(name for name, entry in CATALOGUE.items() if "model" in entry.takes)
HAVE_LINEAR_STAGE = tuple(name for name, entry in CATALOGUE.items() if entry.linear_stage)
CANDIDATES = tuple(name for name, entry in CATALOGUE.items() if entry.automatic)
"""What "auto" chooses from, best first."""


def create(
    name: str, profile: Profile | None = None, stft: StftConfig = StftConfig(), model: str | Path | None = None
) -> Engine | ClipEngine:
    """Make the engine of that name, one of `ENGINES`; it has no state, and streams can share it.

    profile: the calibrated robot; the engines of `NEEDS_PROFILE` do not work without, and `crnn` answers otherwise with
    one. stft: for the engines that work with any. model: the file that an engine of `HAVE_MODEL` loads in place of its own.
    Raises UsageError for an unknown name, a missing profile, or a model for an engine that has no use for it, and
    ModelError for a model file that does not fit.

    >>> create("linear").stft.hop
    256
    """
    if name not in CATALOGUE:
        raise UsageError(f"unknown engine '{name}': choose one of auto, {', '.join(ENGINES)}")
    entry = CATALOGUE[name]
    if model is not None and name not in HAVE_MODEL:
        raise UsageError(
            f"engine {name} has no network, found the model {model}: leave it out or take one of"
            f" {', '.join(HAVE_MODEL)}"
        )
    if profile is None and name in NEEDS_PROFILE:
        raise UsageError(
            f"engine {name} needs the robot's calibrated response: give --profile P.npz (made by 'edgefilter"
            " calibrate')"
        )
    factory = getattr(importlib.import_module(f"edgefilter.engines.{entry.module}"), entry.factory)
    given = {"stft": stft, "model": model, "profile": profile}
    return factory(*(given[argument] for argument in entry.takes))
