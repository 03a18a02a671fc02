"""How often chance alone would make an effect look as real: a score test on samples that no fit has seen, and a rate of false names."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy

from edgefilter.diagnosis.score import Judge
from edgefilter.echo.evidence import Score
from edgefilter.types import Array

SPAN = 32
"""Samples (2 ms) whose sums are taken for independent of each other: longer than the whitened fan's correlation, and short enough
that a clipped peak in each word is many of them (of a recording of 12 s: 2e-3 with spans of 16 ms, 2e-5 with these)."""


def p_value(judge: Judge, before: Score, after: Score, of_noise: bool = False) -> float:
    """With what probability a change of a prediction, or of the noise that is expected, explains as much by chance.

    before, after: of a model without and with an effect that was fitted to the other half. of_noise: whether it leaves the
    voice alone. The change of the prediction, whitened,
    times what was left without it is summed over spans of 2 ms; by chance these sums are as often below zero as above, so
    that their total over the root of their squares is a normal number (a score test whose variance is taken from the spans
    themselves: White 1980). An effect that changes the noise alone is judged by its log likelihood, cell by cell, in the same way.
    """
    change = after.prediction - before.prediction
    if change.any() and not of_noise:
        measurement = judge.measurement
        left = measurement.white_recording - measurement.whiten(before.prediction)
        products = left * measurement.whiten(change) * judge.prepared.held_out
        sums = np.add.reduceat(products, np.arange(0, products.size, SPAN), dtype=np.float64)
    else:
        sums = np.ravel((before.deviance - after.deviance) / judge.freedom)
    return _one_sided(sums)


def _one_sided(sums: Array) -> float:
    """Of independent sums of unknown variance around zero: the probability of as large a total."""
    spread = float(np.sqrt(np.sum(sums**2)))
    return float(scipy.special.ndtr(-float(np.sum(sums)) / spread)) if spread > 0.0 else 1.0


def discovered(p_values: Mapping[str, float], tried: int, rate: float) -> set[str]:
    """Names of which at most the share `rate` is false, of so many that were tried (Benjamini & Hochberg 1995)."""
    ranked = sorted(p_values, key=lambda name: p_values[name])
    passing = [place for place, name in enumerate(ranked, start=1) if p_values[name] <= rate * place / max(tried, 1)]
    return set(ranked[: max(passing, default=0)])
