"""Intervals and percentiles, as every result states them."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence

import numpy as np

RESAMPLES = 2000


def interval(statistic: Callable[..., np.ndarray], *columns: Sequence[float]) -> tuple[float, float]:
    """95 % percentile bootstrap interval (Efron & Tibshirani 1993, ch. 13) over utterances, with a fixed seed.

    columns: (n,) each, resampled together; statistic maps (RESAMPLES, n) arrays to (RESAMPLES,).
    """
    arrays = [np.asarray(column, np.float64) for column in columns]
    draws = np.random.default_rng(0).integers(0, arrays[0].size, size=(RESAMPLES, arrays[0].size))
    low, high = np.percentile(statistic(*(array[draws] for array in arrays)), [2.5, 97.5])
    return float(low), float(high)


def cluster_weights(*factors: Sequence[Hashable]) -> np.ndarray:
    """How often each of n utterances is drawn, (RESAMPLES, n), where speakers, rooms and the like are drawn and not they.

    factors: for each utterance the cluster that it belongs to. Each factor's clusters are drawn with replacement, on
    their own; an utterance counts as often as the product says (the pigeonhole bootstrap, Owen 2007, a little too wide
    rather than too narrow). A factor of one cluster says nothing and stays as it is. With a fixed seed.
    """
    rng = np.random.default_rng(0)
    weights = np.ones((RESAMPLES, len(factors[0])))
    for factor in factors:
        names = {name: index for index, name in enumerate(dict.fromkeys(factor))}
        drawn = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=RESAMPLES)
        weights *= drawn[:, [names[name] for name in factor]]
    return weights


def ratio_interval(
    weights: np.ndarray, above: Sequence[float], below: Sequence[float] | None = None
) -> tuple[float, float]:
    """95 % percentile interval of sum(above) / sum(below), (n,) each, over draws of `cluster_weights`; a mean without below."""
    below_array = np.ones(len(above)) if below is None else np.asarray(below, np.float64)
    sums = weights @ below_array
    ratios = (weights @ np.asarray(above, np.float64))[sums > 0] / sums[sums > 0]
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(low), float(high)


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson 1927), as numbers from 0 to 1.

    >>> [round(bound, 3) for bound in wilson(0, 100)]
    [0.0, 0.037]
    """
    if n == 0:
        return 0.0, 1.0
    z, p = 1.959964, hits / n
    centre, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, (centre - half) / (1 + z * z / n)), min(1.0, (centre + half) / (1 + z * z / n))


def percentiles(values: Sequence[float], *percents: float) -> dict[str, float]:
    """p50, p95, ... of the values; 100 is called max.

    >>> percentiles([1.0, 2.0, 3.0], 50, 100)
    {'p50': 2.0, 'max': 3.0}
    """
    found = np.percentile(values, percents)
    return {
        "max" if percent == 100 else f"p{percent:g}": float(value)
        for percent, value in zip(percents, found, strict=True)
    }
