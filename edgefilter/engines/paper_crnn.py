"""'paper-crnn': the source paper's network, which reads the whole clip in both directions and so answers only at its end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from edgefilter.engines.base import FrontEndKind
from edgefilter.engines.onnx_session import expect_answer, expect_slots, find_model, open_model
from edgefilter.engines.paper_ss import PAPER_STFT
from edgefilter.errors import ModelError
from edgefilter.types import SAMPLE_RATE, Frame, Spectrum

PAPER_TYPE = "edgefilter-paper-crnn"
PAPER_VERSION = 1
VARIABLE = "EDGEFILTER_PAPER_CRNN"
MAX_SECONDS = 60
"""Longest clip; the convolutions hold about 50 MB for each second of it. The paper's clips have 5 s."""


class PaperCrnn:
    """CRNN of Li, Hindriks & Kunneman 2024, section 3.3: a soft mask from both magnitudes, on the mixture, with the mixture's phase.

    model: an ONNX file made by export/onnx_export.py from a PaperCrnn checkpoint; without one the file that
    EDGEFILTER_PAPER_CRNN names. The package brings none. Raises ModelError for a file that is not such a model.
    """

    name: ClassVar[str] = "paper-crnn"
    front: ClassVar[FrontEndKind] = "paper"
    stft = PAPER_STFT
    lookahead = None
    longest = MAX_SECONDS * SAMPLE_RATE // PAPER_STFT.hop

    def __init__(self, model: str | Path | None = None) -> None:
        remedy = (
            "train one with 'python -m export.train --network paper' and convert it with 'python -m export.onnx_export'"
        )
        self.model = open_model(find_model(model, VARIABLE, "paper_crnn.onnx", remedy), PAPER_TYPE, PAPER_VERSION)
        if self.model.stft != PAPER_STFT:
            raise ModelError(
                f"model {self.model.path} is for {self.model.stft}, expected {PAPER_STFT}: train it on that"
            )
        clip = (1, "any", PAPER_STFT.bins)
        expect_slots(self.model, {"mic_magnitude": clip, "reference_magnitude": clip}, {"mask": clip})
        ones, power = np.ones(PAPER_STFT.bins, np.complex64), np.ones(PAPER_STFT.bins, np.float32)
        expect_answer(self.model.path, lambda: self.answer([Frame(ones, ones, ones, ones, power, power)] * 2))

    def answer(self, frames: Sequence[Frame]) -> list[Spectrum]:
        """The human's spectrum for each frame of the clip."""
        mic = np.stack([frame.mic for frame in frames])
        reference = np.stack([frame.reference for frame in frames])
        inputs = {"mic_magnitude": np.abs(mic)[None], "reference_magnitude": np.abs(reference)[None]}
        return list(self.model.session.run(["mask"], inputs)[0][0] * mic)
