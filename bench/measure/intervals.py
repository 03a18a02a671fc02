"""Intervals and percentiles, as every result states them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

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
