"""A low shelf and its inverse, hop by hop: what lies below the voice is lowered, and raised again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgefilter.dsp import fourier
from edgefilter.types import SAMPLE_RATE, Samples

ShelfState = NDArray[np.complex128]


class Shelf:
    """The filter (s^2 + s z sqrt 2 + z^2) / (s^2 + s p sqrt 2 + p^2): gain (z / p)^2 far below z and p, 1 far above.

    hop: samples per step. zero_hz, pole_hz: corners z and p, by the bilinear transform; Shelf(hop, p, z) undoes
    Shelf(hop, z, p). power: (hop + 1,) float32, squared gain from 0 Hz to Nyquist.
    """

    def __init__(self, hop: int, zero_hz: float, pole_hz: float) -> None:
        (zero, above), (pole, below) = _root(zero_hz), _root(pole_hz)
        first = above / below  # sample of the impulse response
        residue = first * (pole - zero) * (pole - zero.conjugate()) / (pole - pole.conjugate()) / pole
        self._direct = np.float32(first - 2.0 * residue.real)
        self._falling = 2.0 * residue * pole ** np.arange(1, hop + 1)
        self._rising: ShelfState = np.power(pole, -np.arange(1.0, hop + 1.0), dtype=np.complex128)
        self._carried = pole**hop
        turn = np.exp(1j * np.pi * np.arange(hop + 1) / hop)
        response = first * np.prod(
            [(turn - a) / (turn - b) for a, b in ((zero, pole), (zero.conj(), pole.conj()))], axis=0
        )
        self.power: Samples = fourier.power(response.astype(np.complex64))

    def step(self, x: Samples, state: ShelfState | float) -> tuple[Samples, ShelfState]:
        """The next hop x (..., hop), filtered, and the state behind it, (..., 1). state: that of the last hop, 0 at first."""
        # a cast of its own takes less time than the product's, which goes piece by piece
        sums = np.add.accumulate(self._rising * x.astype(np.complex128), axis=-1)
        sums += state
        y = (self._falling * sums).real.astype(np.float32)
        y += self._direct * x
        return y, self._carried * sums[..., -1:]


def _root(hz: float) -> tuple[np.complex128, float]:
    """Root in z of the quadratic of that corner, and the coefficient of its z^2."""
    k = np.tan(np.pi * hz / SAMPLE_RATE)
    leading = 1.0 + np.sqrt(2.0) * k + k**2
    return np.complex128(complex(1.0 - k**2, np.sqrt(2.0) * k) / leading), float(leading)
