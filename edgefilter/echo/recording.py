"""A recording of the robot beside its reference: its least length, the samples that are fitted on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgefilter.dsp.lag import one_signal
from edgefilter.errors import SignalError
from edgefilter.types import SAMPLE_RATE, Samples, as_samples

MIN_SECONDS = 1.0
"""Seconds of the shortest recording, two BLOCKs, one to fit on and one to test."""
BLOCK = SAMPLE_RATE // 2
"""Samples of the blocks that are fitted and tested on in turn."""


def fitted_blocks(n: int) -> NDArray[np.bool_]:
    """Every other BLOCK, from the first on, (n,): what a fit may use, so that the rest can test it."""
    return np.arange(n) // BLOCK % 2 == 0


def paired(recording: object, reference: object) -> tuple[Samples, Samples]:
    """Both as float32 of the recording's length, silence behind a shorter reference.

    Raises SignalError where either is shorter than MIN_SECONDS, and where both are the same signal.
    """
    y, x = as_samples(recording, "recording"), as_samples(reference, "reference")
    for samples, name in ((y, "recording"), (x, "reference")):
        if samples.size < MIN_SECONDS * SAMPLE_RATE:
            seconds = samples.size / SAMPLE_RATE
            raise SignalError(
                f"the {name} is {seconds:.2f} s long, expected at least {MIN_SECONDS:g} s of the robot's voice"
            )
    x = np.pad(x, (0, max(y.size - x.size, 0)))[: y.size]
    if one_signal(float(y.dot(x)), float(y.dot(y)), float(x.dot(x))):
        raise SignalError(
            "the recording and the reference are the same signal: give what the microphone recorded, and for the reference"
            " what was sent to the loudspeaker"
        )
    return y, x
