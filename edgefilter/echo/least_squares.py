"""Least squares in short FIR filters: what of a recording several known signals explain, each with its own few taps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from edgefilter.dsp.convolution import filtered
from edgefilter.types import Array, Samples

NUISANCE_TAPS, NUISANCE_LEAD = 16, 8
"""Of the filter on a prediction that takes up what is ordinary: a slightly other gain, a move of less than a millimetre."""
CHUNK = 8192
"""Rows that are multiplied at once, so that memory stays bounded."""
RIDGE = 1e-6
"""Of an unknown's own energy: keeps equations soluble, and changes no weight that is heard."""


def ridge_solved(matrix: Array, right: Array, ridge: Array | float, energy: Array | None = None) -> Array:
    """Weights (k,) of normal equations (k, k), (k,); ridge, (k,) or one for all, is relative to energy (k,): by default each one's own."""
    scale = np.sqrt(matrix.diagonal() if energy is None else energy) + 1e-30
    scaled = matrix / scale[:, None] / scale
    return np.linalg.solve(scaled + np.diag(np.broadcast_to(ridge, scale.shape)), right / scale) / scale


def at_lags(x: Samples, taps: int, lead: int) -> Samples:
    """The samples of x (n,) that a filter reads at each moment, (n, taps), a view: tap k a delay of k - lead, silence outside of x."""
    return sliding_window_view(np.pad(x, (taps - 1 - lead, lead)), taps)[:, ::-1]


def normal_equations(
    columns: Sequence[Samples], target: Samples, taps: int, lead: int, fit: np.ndarray | None
) -> tuple[Array, Array]:
    """Normal equations (C * taps, C * taps), (C * taps,) for columns (C, n), each at_lags(), and a target (n,).

    fit (n,) bool: the samples that count, None for all.
    """
    size = len(columns) * taps
    windows = [at_lags(column, taps, lead) for column in columns]
    matrix, right = np.zeros((size, size)), np.zeros(size)
    used = np.arange(target.size) if fit is None else np.flatnonzero(fit)
    for at in range(0, used.size, CHUNK):
        chosen = used[at : at + CHUNK]
        rows = np.concatenate([w[chosen] for w in windows], axis=1)
        matrix += rows.T @ rows
        right += rows.T @ target[chosen]
    return matrix, right


def fitted_taps(
    x: Samples, target: Samples, taps: int, lead: int, fit: np.ndarray | None, ridge: float = RIDGE
) -> Array:
    """The filter (taps,) of x (n,) that comes closest to a target (n,); ridge is relative to the energy of x."""
    matrix, right = normal_equations([x], target, taps, lead, fit)
    return ridge_solved(matrix, right, ridge, np.full(taps, matrix.diagonal().mean()))


def hats(x: Array, knots: Array, beyond: bool = False) -> Array:
    """Parts whose sum by heights at the knots (k,) is the curve through these at x (n,), (k, n) float32.

    beyond: whether it goes on as it ends outside of the knots, rather than level.
    """
    left = np.clip(np.searchsorted(knots, x) - 1, 0, knots.size - 2)
    share = ((x - knots[left]) / (knots[left + 1] - knots[left])).astype(np.float32)
    share = share if beyond else np.clip(share, 0.0, 1.0)
    parts = np.zeros((knots.size, x.size), np.float32)
    at = np.arange(x.size)
    parts[left, at], parts[left + 1, at] = 1.0 - share, share
    return parts


def absorbed(predicted: Samples, target: Samples, fit: np.ndarray | None = None) -> Samples:
    """Put predicted (n,) through the short filter that brings it closest to target (n,): what is left is not ordinary."""
    taps = fitted_taps(predicted, target, NUISANCE_TAPS, NUISANCE_LEAD, fit)
    return filtered(predicted, taps, NUISANCE_LEAD)
