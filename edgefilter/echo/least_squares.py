"""Least squares in short FIR filters: what of a recording several known signals explain, each with its own few taps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from edgefilter.dsp.convolution import convolve
from edgefilter.types import Array, Samples

NUISANCE_TAPS, NUISANCE_LEAD = 16, 8
"""Of the filter on a prediction that takes up what is ordinary: a slightly other gain, a move of less than a
millimetre."""
CHUNK = 8192
"""Rows that are multiplied at once, so that memory stays bounded."""


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of target(n) = sum over c and k of w[c, k] column_c(n + lead - k), summed over the chosen n.

    matrix: (C * taps, C * taps) float64. right: (C * taps,). energy: of the target over the chosen samples. count: how
    many these are.
    """

    matrix: Array
    right: Array
    energy: float
    count: int
    taps: int

    def solve(self, ridge: float = 1e-6, use: np.ndarray | None = None) -> tuple[Array, float]:
        """Weights (C, taps) float64 and the energy that they leave; ridge is relative to each column's own energy.

        use: (C, taps) bool, the taps that may differ from zero, None for all.
        """
        chosen = np.arange(self.right.size) if use is None else np.flatnonzero(use)
        matrix, right = self.matrix[np.ix_(chosen, chosen)], self.right[chosen]
        scale = (
            np.sqrt(np.repeat(self.matrix.diagonal().reshape(-1, self.taps).mean(axis=1), self.taps))[chosen] + 1e-30
        )
        scaled = matrix / scale[:, None] / scale
        w = np.linalg.solve(scaled + ridge * np.eye(scale.size), right / scale) / scale
        left = self.energy - 2.0 * float(w @ right) + float(w @ matrix @ w)
        weights = np.zeros(self.right.size)
        weights[chosen] = w
        return weights.reshape(-1, self.taps), max(left, 0.0)


def normal_equations(
    columns: Sequence[Samples], target: Samples, taps: int, lead: int = 0, fit: np.ndarray | None = None
) -> Normal:
    """Normal equations for columns (C, n) and a target (n,); fit (n,) bool: the samples that count, None for all.

    Tap k of a column is a delay of k - lead samples; outside of a column there is silence.
    """
    n, size = target.size, len(columns) * taps
    padded = [np.concatenate((np.zeros(taps - 1 - lead, np.float32), c, np.zeros(lead, np.float32))) for c in columns]
    windows = [sliding_window_view(c, taps)[:, ::-1] for c in padded]
    matrix, right, energy, count = np.zeros((size, size)), np.zeros(size), 0.0, 0
    used = None if fit is None else np.flatnonzero(fit)
    for at in range(0, n if used is None else used.size, CHUNK):
        chosen = slice(at, at + CHUNK) if used is None else used[at : at + CHUNK]
        rows = np.concatenate([w[chosen] for w in windows], axis=1)
        y = target[chosen]
        matrix += rows.T @ rows
        right += rows.T @ y
        energy += float(np.dot(y, y))
        count += y.size
    return Normal(matrix, right, energy, count, taps)


def short_filter(x: Samples, taps: Samples) -> Samples:
    """The full convolution of x (n,) and taps (t,), (n + t - 1,): by the way that is faster for a hop, or for a recording."""
    return (
        convolve(x, taps).astype(np.float32, copy=False) if x.size > CHUNK and taps.size > 4 else np.convolve(x, taps)
    )


def filtered(columns: Sequence[Samples], weights: Array, lead: int = 0) -> Samples:
    """Sum over c of column_c filtered by weights[c]: (n,) float32.

    Weights (C, taps), tap k a delay of k - lead samples.
    """
    n = columns[0].size
    out = np.zeros(n, np.float32)
    for column, w in zip(columns, weights, strict=True):
        if n and w.any():
            out += short_filter(np.concatenate((column, np.zeros(lead, np.float32))), w.astype(np.float32))[
                lead : lead + n
            ]
    return out


def absorbed(predicted: Samples, target: Samples, fit: np.ndarray | None = None) -> Samples:
    """Put predicted (n,) through the short filter that brings it closest to target (n,): what is left is no ordinary tolerance."""
    weights, _ = normal_equations([predicted], target, NUISANCE_TAPS, NUISANCE_LEAD, fit).solve()
    return filtered([predicted], weights, NUISANCE_LEAD)
