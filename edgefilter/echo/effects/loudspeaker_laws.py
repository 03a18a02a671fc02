"""What a loudspeaker adds to what it is sent: a moving coil whose laws bend with its displacement, behind an amplifier that bends."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.membrane import motion
from edgefilter.types import SAMPLE_RATE, Samples

DRIVER_TERMS, AMPLIFIER_TERMS = 6, 4


def driver_terms(x: Samples, resonance_hz: float, excursion: float, sample_rate: int = SAMPLE_RATE) -> Samples:
    """The terms s x, s^2 x, -s d, -s^2 d, -s d'/w, -s^2 d'/w for the drive x (n,), (6, n) float32.

    The equation of motion d'' + (w/Q) d' + w^2 d = w^2 x keeps its left side when force factor, stiffness and damping
    depend on the displacement d; what they change is a drive of its own on the right side (Klippel 2006, "Loudspeaker
    nonlinearities", eq. (2) and (3)). Here to first order: d is the linear membrane's, and each law is a s + b s^2 of
    s = u / sqrt(1 + u^2), u = d / excursion, as of a membrane that can go no farther: nothing grows faster than x.
    """
    moved = motion(x, resonance_hz, sample_rate)
    s = bent(moved[0], excursion)
    driven = np.stack((x, -moved[0], -moved[1]))
    terms = np.empty((3, 2, x.size), np.float32)
    np.multiply(driven, s, out=terms[:, 0])
    np.multiply(terms[:, 0], s, out=terms[:, 1])
    return terms.reshape(DRIVER_TERMS, x.size)


def amplifier_terms(x: Samples, knee: float) -> Samples:
    """The terms s x, s^2 x, s^3 x, s^4 x with s = u / sqrt(1 + u^2), u = x / knee, (4, n) float32."""
    s = bent(x, knee)
    terms = np.empty((AMPLIFIER_TERMS, x.size), np.float32)
    np.multiply(x, s, out=terms[0])
    for before, term in zip(terms, terms[1:], strict=False):
        np.multiply(before, s, out=term)
    return terms


def bent(x: Samples, scale: float) -> Samples:
    """Bounded: u / sqrt(1 + u^2) of u = x / scale (n,), as x / scale where that is small, and never beyond 1."""
    u = x / np.float32(scale)
    return u / np.sqrt(np.float32(1.0) + u * u)
