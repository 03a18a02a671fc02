"""Least squares in short FIR filters: what of a recording several known signals explain, each with its own few taps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of target(n) = sum over c and k of w[c, k] column_c(n + lead - k), summed over the chosen n.

    matrix: (C * taps, C * taps) float64. right: (C * taps,). energy: of the target over these samples.
    """

    matrix: Array
    right: Array
    energy: float
    taps: int

    def solve(self, ridge: float = RIDGE) -> tuple[Array, float]:
        """Weights (C, taps) float64 and the energy that they leave; ridge is relative to each column's own energy."""
        own = np.repeat(self.matrix.diagonal().reshape(-1, self.taps).mean(axis=1), self.taps)
        w = ridge_solved(self.matrix, self.right, ridge, own)
        left = self.energy - 2.0 * float(w @ self.right) + float(w @ self.matrix @ w)
        return w.reshape(-1, self.taps), max(left, 0.0)


def ridge_solved(matrix: Array, right: Array, ridge: Array | float, energy: Array | None = None) -> Array:
    """Weights (k,) of normal equations (k, k), (k,); ridge, (k,) or one for all, is relative to energy (k,): by default each one's own."""
    scale = np.sqrt(matrix.diagonal() if energy is None else energy) + 1e-30
    scaled = matrix / scale[:, None] / scale
    return np.linalg.solve(scaled + np.diag(np.broadcast_to(ridge, scale.shape)), right / scale) / scale


def at_lags(x: Samples, taps: int, lead: int) -> Samples:
    """The samples of x (n,) that a filter reads at each moment, (n, taps), a view: tap k a delay of k - lead, silence outside of x."""
    return sliding_window_view(np.pad(x, (taps - 1 - lead, lead)), taps)[:, ::-1]


def normal_equations(
    columns: Sequence[Samples], target: Samples, taps: int, lead: int = 0, fit: np.ndarray | None = None
) -> Normal:
    """Normal equations for columns (C, n), each at_lags(), and a target (n,); fit (n,) bool: the samples that count, None for all."""
    n, size = target.size, len(columns) * taps
    windows = [at_lags(column, taps, lead) for column in columns]
    matrix, right, energy = np.zeros((size, size)), np.zeros(size), 0.0
    used = None if fit is None else np.flatnonzero(fit)
    for at in range(0, n if used is None else used.size, CHUNK):
        chosen = slice(at, at + CHUNK) if used is None else used[at : at + CHUNK]
        rows = np.concatenate([w[chosen] for w in windows], axis=1)
        y = target[chosen]
        matrix += rows.T @ rows
        right += rows.T @ y
        energy += float(np.dot(y, y))
    return Normal(matrix, right, energy, taps)


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
    weights, _ = normal_equations([predicted], target, NUISANCE_TAPS, NUISANCE_LEAD, fit).solve()
    return filtered(predicted, weights[0], NUISANCE_LEAD)
