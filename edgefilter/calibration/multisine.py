"""A sweep and then random-phase multisines at several levels: making the sound, and finding it in a reference."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.calibration.sweep import generate_sweep, place_of
from edgefilter.errors import CalibrationError
from edgefilter.types import SAMPLE_RATE, Array, Samples

PERIOD = 8192
"""Samples (0.51 s): the path has died away within one, and its lines are 2 Hz apart."""
PERIODS = 3
"""Of each realisation: in the first the path swings in, the others are measured."""
REALISATIONS = 4
LEVELS_DB = (-12.0, -6.0, 0.0)
"""Of the multisines, the softest first; all realisations at each."""
BAND_HZ = (80.0, 7000.0)
"""Above, speech has nothing that counts, and no clock that drifts could be straightened."""
SPEECH_DB = (-376.44, 465.439, -157.745, 16.7124)
"""Density of average speech, dB: coefficients of the powers of lg f, f in Hz, 100 to 8000 (ITU-T P.50, 1999, 2.1)."""
SWEEP_PART = 0.5
"""Peak of the sweep over that of the loudest multisines; it is the louder of the two all the same."""
GROUP = 4
"""Of so many odd lines in a row one, drawn at random, is left out."""
BLOCK = PERIOD * PERIODS


@dataclass(frozen=True, eq=False)
class Realisations:
    """One period of each (REALISATIONS, PERIOD), peak at most 1, all of the same power; which lines each has (., PERIOD / 2 + 1)."""

    periods: Array
    excited: NDArray[np.bool_]


@lru_cache(maxsize=1)
def realisations() -> Realisations:
    """Odd-random multisines: only odd lines, so that an even distortion falls between them, some left out for the odd one.

    Random phases and lines differ from realisation to realisation (Pintelon & Schoukens 2012, sec. 3.4 and 4.3).
    """
    # RandomState: its numbers are the same in every release of numpy, and a recording may be older than the program
    rng = np.random.RandomState(2012)
    hz = np.arange(PERIOD // 2 + 1) * SAMPLE_RATE / PERIOD
    odd = np.flatnonzero((np.arange(hz.size) % 2 == 1) & (hz >= BAND_HZ[0]) & (hz <= BAND_HZ[1]))
    amplitude = 10 ** (np.polynomial.Polynomial(SPEECH_DB)(np.log10(np.maximum(hz, 1.0))) / 20)
    periods, excited = np.zeros((REALISATIONS, PERIOD)), np.zeros((REALISATIONS, hz.size), bool)
    for period, lines in zip(periods, excited):
        groups = odd[: odd.size // GROUP * GROUP].reshape(-1, GROUP)
        lines[odd] = True
        lines[groups[np.arange(len(groups)), rng.randint(GROUP, size=len(groups))]] = False
        period[:] = fft.irfft(lines * amplitude * np.exp(2j * np.pi * rng.uniform(size=hz.size)), PERIOD)
        period /= np.sqrt(np.mean(period**2))
    return Realisations(periods / np.max(np.abs(periods)), excited)


def generate_multisine(amplitude: float = 0.7, lead_s: float = 0.5, tail_s: float = 1.0) -> Samples:
    """A sweep, then multisines at three levels, to be played for a calibration that also measures distortion.

    Parameters
    ----------
    amplitude : float
        Peak of the loudest multisines, full scale 1, whose loud moments are then those of speech of this peak.
    lead_s, tail_s : float
        Of silence before it, and after it for the room to fall silent.

    Returns
    -------
    ndarray of float32, shape (n,)
        At 16 kHz.

    Notes
    -----
    The sweep is that of `generate_sweep`, its peak half as high. A second later follow four realisations of an odd-random multisine (80 to
    7000 Hz with the spectrum of speech, random phases, of every four odd lines one left out), three periods of 0.51 s
    each, 12 dB and 6 dB softer and then as loud as asked for (Pintelon & Schoukens 2012, "System Identification: A Frequency Domain Approach").

    Examples
    --------
    >>> sound = generate_multisine()
    >>> sound.shape, round(float(np.abs(sound[-100_000:]).max()), 2)
    ((430912,), 0.7)
    """
    sweep = generate_sweep(amplitude=SWEEP_PART * amplitude, lead_s=0.0)
    levels = [10 ** (level / 20) * np.tile(realisations().periods, PERIODS).ravel() for level in LEVELS_DB]
    sound = np.concatenate((sweep, amplitude * np.concatenate(levels)))
    return np.pad(sound, (round(lead_s * SAMPLE_RATE), round(tail_s * SAMPLE_RATE))).astype(np.float32)


@dataclass(frozen=True)
class MultisineLaw:
    """Where the sound lies in its reference: the sweep from sample start on, the multisines from sample first on."""

    start: int
    first: int

    @property
    def stop(self) -> int:
        """First sample after the last multisine."""
        return self.first + len(LEVELS_DB) * REALISATIONS * BLOCK

    def blocks(self) -> NDArray[np.intp]:
        """First sample of each multisine, (levels, realisations)."""
        shape = (len(LEVELS_DB), REALISATIONS)
        return self.first + BLOCK * np.arange(shape[0] * shape[1]).reshape(shape)


def multisine_law(reference: Samples) -> MultisineLaw:
    """Recognise the sound of generate_multisine() at any level and place; raise CalibrationError where there is none."""
    pattern = generate_multisine(1.0, 0.0, 0.0).astype(np.float64)
    start = place_of(pattern, reference)
    if start is not None:
        return MultisineLaw(start, start + pattern.size - len(LEVELS_DB) * REALISATIONS * BLOCK)
    seconds = f"{reference.size / SAMPLE_RATE:.1f} s long" if reference.any() else "silent"
    raise CalibrationError(
        f"the sweep reference ({seconds}) is not the sweep with multisines of {pattern.size / SAMPLE_RATE:.1f} s:"
        " play the one that 'calibrate --multisine --excitation FILE' writes, or leave --multisine out"
    )
