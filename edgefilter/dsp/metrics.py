"""How much human is left and how much robot is gone: SI-SDR and ERLE. Numbers only, nothing printed."""

from __future__ import annotations

import math

import numpy as np

from edgefilter.errors import SignalError
from edgefilter.types import Array, as_samples


def si_sdr(estimate: Array, target: Array) -> float:
    """Scale-invariant signal-to-distortion ratio of an estimate of the human, in dB.

    estimate, target: (n,) float, sample-aligned. With a = <estimate, target> / |target|^2,

        SI-SDR = 10 lg( |a target|^2 / |estimate - a target|^2 )

    (Le Roux, Wisdom, Erdogan & Hershey 2019, "SDR - half-baked or well done?", eq. (4) and (5); no mean is removed).
    Computed in float64. inf for an estimate that is a scaled target, -inf for one that holds nothing of it (silence
    included). One sample of misalignment costs decibels: compensate a known delay first. Raises SignalError for
    different lengths, samples that are not finite, or a silent or empty target.

    >>> import numpy as np
    >>> human = np.sin(np.arange(1600) * 0.3)
    >>> round(si_sdr(0.5 * human + 0.05 * np.cos(np.arange(1600) * 0.3), human), 1)
    20.0
    """
    estimate, target = _pair(estimate, "estimate", target, "target")
    energy = float(target @ target)
    if energy == 0.0:
        raise SignalError(
            "SI-SDR: the target is silent, expected the human's own samples: check the span that is scored"
        )
    projection = (float(estimate @ target) / energy) * target
    rest = estimate - projection
    return _ratio_db(float(projection @ projection), float(rest @ rest))


def erle(mic: Array, error: Array) -> float:
    """Echo return loss enhancement, in dB: how much the power at the microphone fell.

    mic, error: (n,) float of the same samples, while the robot speaks alone (with a human present the figure means
    nothing).

        ERLE = 10 lg( sum mic^2 / sum error^2 )

    (ITU-T G.168, clause on ERLE; Haensler & Schmidt 2004, "Acoustic Echo and Noise Control", with sample means for the
    expectations). What the fan adds to both bounds it from above. inf for a silent error.
    Raises SignalError for different lengths, samples that are not finite, or a silent or empty mic.

    >>> import numpy as np
    >>> echo = np.sin(np.arange(1600) * 0.3)
    >>> round(erle(echo, 0.1 * echo), 1)
    20.0
    """
    mic, error = _pair(mic, "mic", error, "error")
    energy = float(mic @ mic)
    if energy == 0.0:
        raise SignalError("ERLE: the microphone is silent, expected the robot's voice: check the span that is measured")
    return _ratio_db(energy, float(error @ error))


def _pair(a: Array, a_name: str, b: Array, b_name: str) -> tuple[Array, Array]:
    as_samples(a, a_name), as_samples(b, b_name)
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if a.size != b.size:
        raise SignalError(
            f"{a_name} has {a.size} samples and {b_name} {b.size}, expected as many: cut both to the same span"
        )
    return a, b


def _ratio_db(signal: float, rest: float) -> float:
    if signal == 0.0:
        return -math.inf
    return 10.0 * math.log10(signal / rest) if rest > 0.0 else math.inf
