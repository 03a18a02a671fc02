"""What makes a clip hard: the quantities by which results are cut, from its signals and what its maker wrote down."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.metrics import FRAME, frame_power
from bench.recordings import Clip, Conversation
from edgefilter.types import SAMPLE_RATE, Samples

PITCH_HZ = (60.0, 400.0)
PITCH_FRAME = SAMPLE_RATE // 25
"""40 ms: two periods of the deepest voice."""
VOICED = 0.6
"""A frame is voiced where the autocorrelation, corrected for the window, reaches so much of the power."""
OCTAVE = 0.03
"""A peak is taken to be so much lower for each octave of lag: a periodic sound has one at every multiple of its period."""
TALKS_DB = 30.0
"""The robot talks in frames within so much of its loudest."""


class Quantity(NamedTuple):
    """By what results are cut: its name in a clip's facts, as a heading, and its digits."""

    key: str
    title: str
    digits: int = 0


QUANTITIES = (
    Quantity("level_db", "Human over everything else, dB", 1),
    Quantity("pitch_hz", "Pitch of the human, Hz"),
    Quantity("rt60_s", "Reverberation time, s", 2),
    Quantity("fan_db", "Human over fan, dB", 1),
    Quantity("distortion_db", "Distortion of the loudspeaker, dB", 1),
    Quantity("before_s", "Robot talked before, s", 1),
)


def facts(clip: Clip) -> dict[str, float]:
    """All that is known of a clip; quantities that nobody knows are left out."""
    found: dict[str, float] = {}
    if clip.human is not None:
        span, mic, human = clip.span, clip.mic, clip.human
        rest = (mic - human)[span]
        found["level_db"] = 10 * np.log10(np.mean(human[span] ** 2) / max(float(np.mean(rest**2)), 1e-12))
        if (pitch := pitch_hz(human[span])) is not None:
            found["pitch_hz"] = pitch
        found["before_s"] = talking_s(clip.ref[: span.start])
    if isinstance(clip.source, Conversation):
        meta = clip.source.meta
        found |= {"rt60_s": meta["rt60"], "fan_db": meta["snr_fan"], "distortion_db": meta["nl_db"]}
    return {key: float(value) for key, value in found.items()}


def talking_s(ref: Samples) -> float:
    """Seconds in which the reference (n,) talks."""
    power = frame_power(ref)
    return float(np.sum(power > 10 ** (-TALKS_DB / 10) * power.max(initial=0.0))) * FRAME / SAMPLE_RATE


def pitch_hz(samples: Samples) -> float | None:
    """Median fundamental of the voiced frames of samples (n,); None without any.

    The highest peak of each frame's autocorrelation over that of its Hann window (Boersma 1993).
    """
    starts = np.arange(0, samples.size - PITCH_FRAME + 1, PITCH_FRAME // 2)
    if not starts.size:
        return None
    window = np.hanning(PITCH_FRAME)
    frames = samples[starts[:, None] + np.arange(PITCH_FRAME)].astype(np.float64)
    loud = np.mean(frames**2, axis=1)
    frames = (frames - frames.mean(axis=1, keepdims=True))[loud > 0.1 * loud.max()] * window
    low, high = (round(SAMPLE_RATE / hz) for hz in reversed(PITCH_HZ))
    lags = _autocorrelation(frames)[:, low:high] / _autocorrelation(window[None])[:, low:high]
    best = np.argmax(lags - OCTAVE * np.log2(np.arange(low, high)), axis=1)
    voiced = lags[np.arange(best.size), best] > VOICED
    return float(np.median(SAMPLE_RATE / (low + best[voiced]))) if voiced.any() else None


def _autocorrelation(frames: np.ndarray) -> np.ndarray:
    """Of each row, from lag 0 on, over that at lag 0."""
    size = 2 * frames.shape[1]
    found = np.fft.irfft(np.abs(np.fft.rfft(frames, size, axis=1)) ** 2, axis=1)
    return found / np.maximum(found[:, :1], 1e-20)
