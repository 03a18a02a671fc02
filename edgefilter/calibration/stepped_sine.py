"""The paper's two readings of |H_m(f) H_s(f)|: from the spectrogram of a sweep, and from a sine that rises in steps of 13 Hz."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgefilter.calibration.sweep import place_of
from edgefilter.dsp.fourier import power
from edgefilter.dsp.frames import frames
from edgefilter.dsp.psd import hann
from edgefilter.errors import CalibrationError
from edgefilter.profile.data import GRID_FFT, GRID_HZ
from edgefilter.types import SAMPLE_RATE, Array, Samples

STEP_HZ = 13
STEPS_HZ = np.arange(0, 8001, STEP_HZ, dtype=np.float64)
STEP_SAMPLES = 1600
"""0.1 s a step, inferred (the paper does not say): one frame of 1200 samples after 400 for the room to settle."""
HOP = 160
_WINDOW = hann(GRID_FFT)


def generate_stepped_sine(amplitude: float = 0.35, lead_s: float = 0.5, tail_s: float = 1.0) -> Samples:
    """The paper's calibration signal (n,) float32: a sine of 0 to 8001 Hz in steps of 13 Hz, 0.1 s each, phase-continuous.

    616 steps, the last at 7995 Hz, 63 s with the silence around it.

    >>> generate_stepped_sine().shape
    (1009600,)
    """
    steps = np.repeat(STEPS_HZ, STEP_SAMPLES)
    tone = amplitude * np.sin(2 * np.pi * np.cumsum(steps) / SAMPLE_RATE)
    return np.pad(tone, (round(lead_s * SAMPLE_RATE), round(tail_s * SAMPLE_RATE))).astype(np.float32)


@dataclass(frozen=True)
class SteppedLaw:
    """Where a stepped sine lies in its reference: step k sounds in samples start + k STEP_SAMPLES and on."""

    start: int
    low_hz: float = float(STEP_HZ)
    high_hz: float = float(STEPS_HZ[-1])

    @property
    def stop(self) -> int:
        """First sample after the last step."""
        return self.start + STEP_SAMPLES * STEPS_HZ.size

    def frequency(self, n: ArrayLike) -> Array:
        """Hz at sample n of the reference."""
        return (np.asarray(n) - self.start) / STEP_SAMPLES * STEP_HZ

    def time(self, hz: float) -> float:
        """Sample of the reference at which the step of hz sounds."""
        return self.start + hz / STEP_HZ * STEP_SAMPLES


def stepped_law(reference: Samples) -> SteppedLaw:
    """Recognise the stepped sine of generate_stepped_sine() at any level and place.

    Raise CalibrationError where there is none.
    """
    pattern = generate_stepped_sine(1.0, 0.0, 0.0).astype(np.float64)
    start = place_of(pattern, reference)
    if start is not None:
        return SteppedLaw(start)
    raise CalibrationError(
        "the sweep reference is not the stepped sine of 0-8001 Hz in steps of 13 Hz, 0.1 s each: "
        "play the one that edgefilter generates, or leave the stepped-sine option out for an exponential sweep"
    )


def response_from_stepped_sine(
    law: SteppedLaw, reference: Samples, recording: Samples, noise: Samples, delay: int, orders: tuple[int, ...]
) -> tuple[Samples, Array]:
    """|H_m(f) H_s(f)| (601,) float32 and the harmonic distortion (len(orders),) dB, from a recording of the stepped sine.

    Eq. (3)-(5) of the paper step by step: (|X_m(f)| - |N(f)|) / |A(f)| with one Hann frame of 1200 samples at the end
    of each step, delay samples later in the recording, |N(f)| the mean magnitude of the fan in such a frame, negative
    differences set to 0. Between the steps the response is interpolated; the 0 Hz step is silent, so it is 0 there.
    Steps beyond the end of the recording read 0. Distortion of order k: energy at k f over the energy at f, steps from
    104 Hz on, the fan's energy subtracted.
    """
    ends = law.start + STEP_SAMPLES * np.arange(1, STEPS_HZ.size + 1)
    at = ends[:, None] + np.arange(-GRID_FFT, 0)
    padded = np.pad(recording.astype(np.float64), (0, max(0, int(ends[-1]) + delay - recording.size)))[
        np.maximum(at + delay, 0)
    ]
    fan, fan_power = mean_magnitude(noise), np.mean(power(_frames(noise)), axis=0)
    played = _tone_magnitude(reference[at].astype(np.float64), STEPS_HZ)
    heard = _tone_magnitude(padded, STEPS_HZ)
    response = np.maximum(heard - np.interp(STEPS_HZ, GRID_HZ, fan), 0.0) / np.maximum(played, 1e-9)
    response[0] = 0.0
    levels = []
    for order in orders:
        use = (STEPS_HZ >= 104.0) & (STEPS_HZ * order < 7600.0)
        excess = _tone_magnitude(padded[use], order * STEPS_HZ[use]) ** 2 - np.interp(
            order * STEPS_HZ[use], GRID_HZ, fan_power
        )
        levels.append(10 * np.log10(max(excess.sum() / max(np.sum(heard[use] ** 2), 1e-30), 1e-10)))
    return np.interp(GRID_HZ, STEPS_HZ, response).astype(np.float32), np.array(levels)


def _tone_magnitude(pieces: Array, frequencies: Array) -> Array:
    """|DFT| of each Hann-weighted piece (k, GRID_FFT) at its own frequency (k,)."""
    turn = np.exp(-2j * np.pi * frequencies[:, None] / SAMPLE_RATE * np.arange(GRID_FFT))
    return np.abs(np.sum(pieces * _WINDOW * turn, axis=1))


def mean_magnitude(samples: Samples) -> Array:
    """Mean |spectrum| (601,) over Hann frames of 1200 samples, hop 160."""
    return np.abs(_frames(samples)).mean(axis=0)


def response_from_sweep(reference: Samples, recording: Samples, noise: Samples, delay: int) -> Samples:
    """The paper's |H_m(f) H_s(f)| (601,) float32, from any sweep: sum_t (|X_m(t,f)| - |N(f)|) / sum_t |A(t,f)|, eq. (3)-(5).

    Hann frames of 1200 samples, hop 160; for each bin, those frames t in which the reference, delayed by delay samples,
    is within 20 dB of its maximum in that bin. Negative sums are set to 0, and so are bins in which the sweep has no
    energy (60 dB below its strongest bin). Reverberation that outlasts the frame is not part of this reading.
    """
    played = np.abs(_frames(np.pad(reference, (max(delay, 0), 0))[max(-delay, 0) :]))
    heard = np.abs(_frames(recording))
    count = min(len(played), len(heard))
    played, heard = played[:count], heard[:count]
    strongest = played.max(axis=0)
    use = played > 0.1 * strongest
    excess = np.sum(use * (heard - mean_magnitude(noise)), axis=0)
    response = np.maximum(excess, 0.0) / np.maximum(np.sum(use * played, axis=0), 1e-9)
    return np.where(strongest > 1e-3 * strongest.max(), response, 0.0).astype(np.float32)


def _frames(samples: Samples) -> NDArray[np.complex128]:
    """(frames, 601) complex spectra."""
    padded = np.pad(samples, (0, max(0, GRID_FFT - samples.size)))
    return np.fft.rfft(frames(padded, GRID_FFT, HOP) * _WINDOW, axis=1)
