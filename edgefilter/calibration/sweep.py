"""Exponential sweeps: making one, recognising one, and what deconvolution by one separates (Farina 2000)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy import fft

from edgefilter.dsp.frames import frames
from edgefilter.dsp.psd import hann
from edgefilter.errors import CalibrationError
from edgefilter.profile.data import DISTORTION_ORDERS, GRID_FFT, GRID_HZ
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

LOW_HZ, HIGH_HZ = 40.0, 7990.0
"""Of the generated sweep: from below what a robot's loudspeaker plays to the end of the band."""
EARLIEST_DIRECT, LATEST_DIRECT = -2000, int(1.6 * SAMPLE_RATE)
"""Samples by which the direct sound may come after it was played, on the recording's counter."""
MIN_TAPS = 6400
"""Samples, 400 ms: what is kept of the impulse response at least."""
DRIFT_REACH = 400
"""Samples by which clocks that are apart may move a lag within a recording: 400 ppm in a minute."""
STRETCHED_PPM = 5.0
"""Difference of two clocks from which on a sweep's path is smeared, by half a sample from its beginning to its end, and a
chirp of 0.3 s by a fortieth of one, which costs 30 dB of 7 kHz."""


def generate_sweep(seconds: float = 6.0, amplitude: float = 0.35, lead_s: float = 0.5, tail_s: float = 1.0) -> Samples:
    """An exponential sweep with silence before and after, to be played for a calibration.

    Parameters
    ----------
    seconds : float
        Of the sweep, from LOW_HZ to HIGH_HZ.
    amplitude : float
        Its peak, full scale 1.
    lead_s, tail_s : float
        Of silence before it, and after it for the room to fall silent.

    Returns
    -------
    ndarray of float32, shape (n,)
        At 16 kHz, faded in over 20 ms and out over 5 ms.

    Notes
    -----
    x(t) = amplitude sin(2 pi f1 T (e^(t/T) - 1)), T = seconds / ln(f2 / f1) (Farina 2000, eq. 5), f1 T rounded to a
    whole number so that harmonics separate with a defined phase (Novak et al. 2015, eq. 37).

    Examples
    --------
    >>> sweep = generate_sweep()
    >>> sweep.shape, sweep.dtype
    ((120000,), dtype('float32'))
    """
    rate = max(1.0, np.round(LOW_HZ * seconds / np.log(HIGH_HZ / LOW_HZ))) / LOW_HZ
    t = np.arange(round(seconds * SAMPLE_RATE)) / SAMPLE_RATE
    tone = amplitude * np.sin(2 * np.pi * LOW_HZ * rate * np.expm1(t / rate))
    up, down = round(0.02 * SAMPLE_RATE), round(0.005 * SAMPLE_RATE)
    tone[:up] *= np.sin(np.linspace(0, np.pi / 2, up)) ** 2
    tone[-down:] *= np.cos(np.linspace(0, np.pi / 2, down)) ** 2
    return np.pad(tone, (round(lead_s * SAMPLE_RATE), round(tail_s * SAMPLE_RATE))).astype(np.float32)


@dataclass(frozen=True)
class SweepLaw:
    """The instantaneous frequency low_hz * exp((n - start) / rate) of samples start <= n < stop; rate in samples."""

    start: int
    stop: int
    low_hz: float
    high_hz: float
    rate: float

    def frequency(self, n: ArrayLike) -> Array:
        """Hz at sample n of the reference."""
        return self.low_hz * np.exp((np.asarray(n) - self.start) / self.rate)

    def time(self, hz: float) -> float:
        """Sample of the reference at which the sweep passes hz."""
        return self.start + self.rate * float(np.log(hz / self.low_hz))

    def lead(self, order: float) -> float:
        """Samples by which the response of a harmonic order precedes the linear one after deconvolution."""
        return self.rate * np.log(order)


def sweep_law(reference: Samples) -> SweepLaw:
    """The law of the exponential sweep that reference is; raises CalibrationError where it is none."""
    level = float(np.max(np.abs(reference), initial=0.0))
    if level < 1e-3:
        raise CalibrationError(
            f"the sweep reference peaks at {level:.1g}, expected a sweep of at least 0.001: is it the right file?"
        )
    active = np.flatnonzero(np.abs(reference) > 0.02 * level)
    start, stop = int(active[0]), int(active[-1]) + 1
    if stop - start < SAMPLE_RATE // 2:
        raise CalibrationError(
            f"the sweep reference sounds for {(stop - start) / SAMPLE_RATE:.2f} s, expected at least 0.5 s of sweep"
        )
    phase = np.unwrap(np.angle(scipy.signal.hilbert(reference[start:stop])))
    step = (stop - start) // 400
    middle = np.arange(step * 20, stop - start - step * 20, step)
    rate_hz = (phase[middle + step // 2] - phase[middle - step // 2]) / (step // 2 * 2) * SAMPLE_RATE / (2 * np.pi)
    usable = rate_hz > 1.0
    why = "its frequency does not rise"
    if usable.mean() >= 0.95:
        slope, offset = np.polyfit(middle[usable], np.log(rate_hz[usable]), 1)
        misfit = float(np.sqrt(np.mean((slope * middle[usable] + offset - np.log(rate_hz[usable])) ** 2)))
        if misfit <= 0.03 and slope * (stop - start) >= np.log(8.0):
            high = min(float(np.exp(offset + slope * (stop - start))), SAMPLE_RATE / 2)
            return SweepLaw(start, stop, float(np.exp(offset)), high, float(1 / slope))
        why = f"its frequency departs by {100 * misfit:.0f} % from an exponential rise"
    raise CalibrationError(
        f"the sweep reference is not an exponential sweep: {why}; play the one that edgefilter generates"
    )


@dataclass(frozen=True, eq=False)
class Deconvolution:
    """Response of the path, circular, with the lag of each sample and what the fan leaves in it.

    response: (n,) float64, lag k at index k (negative lags count from the end). source_energy: (n // 2 + 1,) |S|^2.
    regularisation: (n // 2 + 1,) lambda in H = Y S* / (|S|^2 + lambda). noise_psd: (n // 2 + 1,) two-sided, per sample.
    """

    response: Array
    source_energy: Array
    regularisation: Array
    noise_psd: Array

    def cut(self, start: int, length: int) -> Array:
        """Samples of the response from lag start on, (length,)."""
        return np.take(self.response, np.arange(start, start + length), mode="wrap")

    def spectrum(self, part: Array) -> Array:
        """|H|^2 of a part of the response, (n // 2 + 1,)."""
        return np.abs(fft.rfft(part, self.response.size)) ** 2

    def noise(self, length: float) -> Array:
        """Expected |H|^2 that the fan alone leaves in a part of that many samples, (n // 2 + 1,)."""
        gain = self.source_energy / np.maximum(self.source_energy + self.regularisation, 1e-30) ** 2
        return length * self.noise_psd * gain

    @property
    def frequencies(self) -> Array:
        """Frequencies of the bins, (n // 2 + 1,) in Hz."""
        return np.arange(self.source_energy.size) * SAMPLE_RATE / self.response.size

    @cached_property
    def direct(self) -> int:
        """Lag of the direct sound: of the largest |h| between EARLIEST_DIRECT and LATEST_DIRECT."""
        lags = np.arange(EARLIEST_DIRECT, min(LATEST_DIRECT, self.response.size // 2))
        return int(lags[np.argmax(np.abs(self.response[lags]))])


def deconvolve(reference: Samples, recording: Samples, noise_psd: Array, taps: int = MIN_TAPS) -> Deconvolution:
    """Divide recording by reference in frequency, as far as the fan allows.

    noise_psd: one-sided PSD of the fan on GRID_HZ. lambda(f) = taps P_nn(f) / P_hh(f) is the Wiener solution for a
    response of that many taps with the fan as the only noise; P_hh is a first estimate smoothed over a sixth of an
    octave (Kirkeby & Nelson 1999 give the regularised inverse, without the choice of lambda).
    """
    n = fft.next_fast_len(reference.size + recording.size, real=True)
    source = fft.rfft(reference.astype(np.float64), n)
    cross = fft.rfft(recording.astype(np.float64), n) * source.conj()
    energy = np.abs(source) ** 2
    frequencies = np.arange(energy.size) * SAMPLE_RATE / n
    fan = np.interp(frequencies, GRID_HZ, noise_psd) / 2 * SAMPLE_RATE + 1e-14
    floor = np.full(energy.size, 1e-7 * energy.max())
    first = Deconvolution(fft.irfft(cross / (energy + floor), n), energy, floor, fan)
    raw = smoothed(first.spectrum(first.cut(first.direct - PRE_ROLL, taps)), frequencies, frequencies[1], 5.0)
    below = smoothed(first.noise(taps), frequencies, frequencies[1], 5.0)
    path = np.maximum(raw - below, 1e-3 * below) + 1e-12 * raw.max()
    weight = floor * 1e-3 + taps * fan / path
    return Deconvolution(fft.irfft(cross / (energy + weight), n), energy, weight, fan)


def smoothed(lines: Array, hz: Array, line_hz: float, least_hz: float) -> Array:
    """Mean of lines (..., n), line_hz apart, over a sixth of an octave around each hz, at least 2 least_hz, (..., hz.size)."""
    total = np.cumsum(lines, axis=-1)
    total = np.concatenate((np.zeros_like(total[..., :1]), total), axis=-1)
    half = np.maximum((2 ** (1 / 12) - 1) * hz, least_hz) / line_hz
    low = np.clip(np.floor(hz / line_hz - half), 0, None).astype(int)
    high = np.minimum(np.ceil(hz / line_hz + half) + 1, lines.shape[-1]).astype(int)
    return (total[..., high] - total[..., low]) / (high - low)


def distortion_db(result: Deconvolution, law: SweepLaw) -> Array:
    """Energy of each of DISTORTION_ORDERS' response at k f over the linear one at f, the fan subtracted, (orders,) dB.

    The response of order k arrives T ln k before the linear one (Farina 2000, eq. 14). f runs from 100 Hz (or the sweep's
    start) to 95 % of the sweep's end over k. What the fan hides reads as its own share at most, and at least -100 dB.
    """
    linear = result.spectrum(result.cut(result.direct - 128, 4096))
    frequencies = result.frequencies
    levels = []
    for order in DISTORTION_ORDERS:
        gap = law.lead(order + 1) - law.lead(order)
        length = int(min(4096, 0.8 * gap))
        part = result.cut(result.direct - int(round(law.lead(order))) - min(128, length // 4), length)
        excess = result.spectrum(part) - result.noise(length)
        inside = (frequencies >= order * max(100.0, law.low_hz)) & (frequencies <= 0.95 * law.high_hz)
        fundamental = np.interp(frequencies[inside] / order, frequencies, linear)
        levels.append(10 * np.log10(max(excess[inside].sum() / max(fundamental.sum(), 1e-30), 1e-10)))
    return np.array(levels)


def paper_response(reference: Samples, recording: Samples, noise: Samples, delay: int) -> Samples:
    """The paper's |H_m(f) H_s(f)| (601,) float32, from any sweep: sum_t (|X_m(t,f)| - |N(f)|) / sum_t |A(t,f)|, eq. (3)-(5).

    Hann frames of 1200 samples, hop 160; |N(f)| is the fan's mean magnitude. For each bin, those frames t in which the
    reference, later by delay, is within 20 dB of its maximum there. Negative sums are set to 0, and so are bins 60 dB below
    the sweep's strongest. Reverberation that outlasts the frame is not part of this reading.
    """
    played, heard = _magnitudes(np.pad(reference, (max(delay, 0), 0))[max(-delay, 0) :]), _magnitudes(recording)
    count = min(len(played), len(heard))
    played, heard = played[:count], heard[:count]
    strongest = played.max(axis=0)
    use = played > 0.1 * strongest
    excess = np.sum(use * (heard - _magnitudes(noise).mean(axis=0)), axis=0)
    response = np.maximum(excess, 0.0) / np.maximum(np.sum(use * played, axis=0), 1e-9)
    return np.where(strongest > 1e-3 * strongest.max(), response, 0.0).astype(np.float32)


def _magnitudes(samples: Samples) -> Array:
    """Magnitudes of spectra, a frame every 160 samples, as the paper has them, (frames, 601)."""
    padded = np.pad(samples, (0, max(0, GRID_FFT - samples.size)))
    return np.abs(np.fft.rfft(frames(padded, GRID_FFT, 160) * hann(GRID_FFT), axis=1))
