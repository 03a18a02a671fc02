"""How the linear stage adapts, by what it starts from."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Adaptation:
    """How the Kalman filter believes that the path moves and how its error is read.

    transition: A of the first-order Markov model of the path per hop of 16 ms. noise_memory: weight of the past in the
    measurement-noise PSD. certainty: share of the gain by which a correction lowers the covariance; overlap-save in
    theory has 1/2. products: whether d x and d^2 x are heard beside the reference. posterior: whether the error is
    delivered after the hop's own correction.
    """

    transition: float
    noise_memory: float
    certainty: float
    products: bool
    posterior: bool


COLD = Adaptation(transition=0.9999, noise_memory=0.95, certainty=0.25, products=False, posterior=True)
"""Without a calibrated path."""
WARM = Adaptation(transition=0.99997, noise_memory=0.9, certainty=0.5, products=True, posterior=False)
"""From a calibrated path."""
LEARNED = replace(COLD, products=True)
"""From a path that an earlier run has learned, and for one that is learned beside the filter."""
