"""What flows along the data path: blocks of samples from a source, frames of spectra to an engine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edgefilter.errors import SignalError

SAMPLE_RATE = 16000
"""Samples per second of everything inside; sources convert at the door."""
PRE_ROLL = 64
"""Samples (4 ms) of the impulse response before the direct sound: what equalisers and linear-phase filters of a loudspeaker ring ahead of it."""

Array: TypeAlias = NDArray[np.floating]
Samples: TypeAlias = NDArray[np.float32]
Spectrum: TypeAlias = NDArray[np.complex64]


@dataclass(frozen=True, slots=True)
class Block:
    """Samples of both channels that belong to the same stretch of the sample counter.

    mic, ref: (n,) float32, full scale +-1, any n >= 0. start: counter of the first sample.
    lost: samples that the source could not deliver since the previous block (their place is filled, never silently).
    """

    mic: Samples
    ref: Samples
    start: int
    lost: int = 0


class Frame(NamedTuple):
    """One STFT frame as an engine sees it; a tuple, as all that is made once a hop: a frozen dataclass takes twice as long to make.

    mic, reference, echo, error: (bins,) complex64. reference is delayed to where the robot's voice arrives at the
    microphone, echo is the linear stage's estimate of it, error = mic - echo. noise_psd, residual_psd: (bins,) float32,
    expected |spectrum|^2 of the fan and of what is left of the echo in error.
    """

    mic: Spectrum
    reference: Spectrum
    echo: Spectrum
    error: Spectrum
    noise_psd: Samples
    residual_psd: Samples


class Output(NamedTuple):
    """An engine's answer: the human's spectrum (bins,) complex64 and, if it judges that, whether a human speaks (0-1)."""

    spectrum: Spectrum
    speech_probability: float | None = None


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a user of the stream may want to know: what happened and by which sample of the microphone, whole hops."""

    kind: str
    sample: int
    detail: str


def as_samples(x: object, name: str) -> Samples:
    """Return x as a finite (n,) float32 array, contiguous, without writing into it; raise SignalError otherwise."""
    array = np.asarray(x)
    if array.dtype.kind != "f":
        raise SignalError(f"{name} has dtype {array.dtype}, expected float samples in +-1: divide integer PCM by its full scale")
    if array.ndim != 1:
        raise SignalError(f"{name} has shape {array.shape}, expected one channel of shape (n,)")
    array = np.ascontiguousarray(array, np.float32)
    if not math.isfinite(array.dot(array)) and not np.isfinite(array).all():
        bad = int(np.argmin(np.isfinite(array)))
        raise SignalError(f"{name} holds {array[bad]} at sample {bad}, expected finite samples: repair or cut the recording")
    return array
