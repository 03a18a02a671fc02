"""Chirps that tell whether microphone and reference are set up rightly: what was recorded of them, evaluated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import soxr
from scipy import fft

from edgefilter.calibration.multisine import BAND_HZ
from edgefilter.calibration.sweep import STRETCHED_PPM
from edgefilter.dsp.fourier import power
from edgefilter.dsp.frames import block_power, decibels, rise, stretch
from edgefilter.dsp.lag import correlation_near, flat_cross
from edgefilter.dsp.membrane import LOWEST_HZ
from edgefilter.types import SAMPLE_RATE, Samples

LEVEL_DB = -18.0
"""Peak of the louder chirps, dB of full scale: their power is that of usual robot speech, whose peaks are some dB higher."""
SOFTER_DB = 10.0
"""By how much every other pair is softer: what changes the level by itself makes less, or more, of it."""
_, HIGHEST_HZ = BAND_HZ
SLOT, CHIRP, FADE = round(0.6 * SAMPLE_RATE), round(0.3 * SAMPLE_RATE), round(0.01 * SAMPLE_RATE)
"""Samples from one chirp to the next, of a chirp, and of its rise and fall: the rest of a slot is for the room's echo."""
ORDER = "UDudDUdu"
"""Up and down, louder (capital) and softer; the first half is fitted and the second tests that it was a linear filter."""
LEAD = round(0.5 * SAMPLE_RATE)
"""Samples of silence before the first chirp, in which the room's noise is measured."""
QUIET = round(0.1 * SAMPLE_RATE)
"""Samples of the quietest stretch of LEAD, which counts as the room's noise: a stream may begin with a click."""
OVER_RMS = 12.0
"""Height of a correlation with the chirps over its root mean square from which they are there: noise has 5."""


def chirps() -> Samples:
    """The sound to be played, (n,) float32 at 16 kHz, 5.3 s with the silence before."""
    time = np.arange(CHIRP) / SAMPLE_RATE
    phase = 2 * np.pi * (LOWEST_HZ * time + (HIGHEST_HZ - LOWEST_HZ) / (2 * time[-1]) * time**2)
    up = np.sin(phase)
    up[:FADE] *= rise(FADE)
    up[-FADE:] *= rise(FADE)[::-1]
    sound = np.zeros(LEAD + SLOT * len(ORDER), np.float32)
    for number, kind in enumerate(ORDER):
        level_db = LEVEL_DB - (0.0 if kind.isupper() else SOFTER_DB)
        at = LEAD + number * SLOT
        sound[at : at + CHIRP] = 10 ** (level_db / 20) * (up if kind in "Uu" else up[::-1])
    return sound


@dataclass(frozen=True)
class Heard:
    """What a microphone and a reference brought of the chirps.

    in_reference, in_microphone: whether they are there; where one lacks them, what follows is None. peak_db: of the
    microphone, dB of full scale. lag_s: seconds by which it hears them later. above_noise_db: of the louder ones. ppm: by
    how much its clock is faster. linear_db: power of the echo over what a linear filter, fitted to other chirps, leaves of it.
    softer_db: gain for the softer chirps over that for the louder ones. same: whether it is a copy of the reference.
    """

    in_reference: bool
    in_microphone: bool
    peak_db: float
    lag_s: float | None = None
    above_noise_db: float | None = None
    ppm: float | None = None
    linear_db: float | None = None
    softer_db: float | None = None
    same: bool = False


def evaluate(mic: Samples, ref: Samples) -> Heard:
    """Look for the chirps in both channels (n,), which share a sample counter.

    >>> sound = np.pad(chirps(), (4000, 12000))
    >>> heard = evaluate(0.1 * np.roll(sound, 800), sound)
    >>> round(1000 * heard.lag_s), round(heard.ppm), heard.linear_db > 40, round(heard.softer_db)
    (50, 0, True, 0)
    """
    heard = _evaluate_as_is(mic, ref)
    if heard.ppm is not None and abs(heard.ppm) > STRETCHED_PPM:
        straight = _evaluate_as_is(soxr.resample(mic, 1e6 + heard.ppm, 1e6), ref)
        if straight.ppm is not None:
            return replace(straight, ppm=heard.ppm + straight.ppm)
    return heard


def _evaluate_as_is(mic: Samples, ref: Samples) -> Heard:
    sound = chirps()
    peak_db = float(decibels(float(np.max(np.square(mic), initial=0.0))))
    (at_ref, in_ref), (at_mic, in_mic) = _find(ref, sound), _find(mic, sound)
    if not (in_ref and in_mic):
        return Heard(in_ref, in_mic, peak_db)
    starts = at_ref + LEAD + SLOT * np.arange(len(ORDER))
    lag = at_mic - at_ref
    size = fft.next_fast_len(2 * SLOT, real=True)
    references, heard = _slots(ref, starts - FADE, size), _slots(mic, starts + lag - FADE, size)
    offsets, ppm = _drift(heard, references, starts, size)
    omega = 2 * np.pi * np.arange(heard.shape[1]) / size
    heard = heard * np.exp(1j * omega * offsets[:, None])
    noise = block_power(mic[max(at_mic, 0) :][: LEAD - FADE], QUIET).min()
    band = slice(round(LOWEST_HZ * size / SAMPLE_RATE), round(HIGHEST_HZ * size / SAMPLE_RATE))
    loud = np.array([kind.isupper() for kind in ORDER])
    in_noise = noise * SLOT * size / 2 * (HIGHEST_HZ - LOWEST_HZ) / (SAMPLE_RATE / 2)
    energy = np.sum(power(heard[:, band]), axis=1) - in_noise
    given = np.sum(power(references[:, band]), axis=1)
    gain_db = [float(decibels(max(float(np.sum(energy[of]) / np.sum(given[of])), 1e-12))) for of in (loud, ~loud)]
    over = np.mean([np.mean(np.square(mic[at : at + CHIRP], dtype=np.float64)) for at in starts[loud] + lag])
    left_db, same = _left(heard, references, band, size)
    return Heard(
        in_ref, in_mic, peak_db, lag / SAMPLE_RATE, float(decibels(float(over / max(noise, 1e-12)))), ppm, left_db,
        gain_db[1] - gain_db[0], same and abs(lag) <= FADE and abs(ppm) < 1.0,
    )  # fmt: skip


def _find(heard: Samples, sound: Samples) -> tuple[int, bool]:
    """Where the sound begins in what was heard, in samples, and whether it is there."""
    if not heard.any():
        return 0, False
    size = fft.next_fast_len(heard.size + sound.size, real=True)
    correlation = np.abs(fft.irfft(flat_cross(sound, heard, size), size))
    at = int(np.argmax(correlation))
    return at if at < heard.size else at - size, bool(correlation[at] > OVER_RMS * np.sqrt(np.mean(correlation**2)))


def _slots(x: Samples, starts: np.ndarray, size: int) -> np.ndarray:
    """Spectra of the slots of x (n,) from each start on, (slots, size // 2 + 1); zeros where there is nothing."""
    return fft.rfft(np.array([stretch(x, at, at + SLOT) for at in starts], np.float64), size)


def _drift(heard: np.ndarray, references: np.ndarray, starts: np.ndarray, size: int) -> tuple[np.ndarray, float]:
    """By how many samples each slot is late, on a line through all of them, and the clock's difference, ppm."""
    lags = []
    for y, r in zip(heard, references):
        near = correlation_near(y * np.conj(r), size, 16)  # +- 1 ms: 300 ppm of 5 s are 24 samples
        at = min(max(int(np.argmax(np.abs(near))), 1), 31)
        low, middle, high = np.abs(near[at - 1 : at + 2])
        lags.append(at - 16 + 0.5 * (low - high) / min(low - 2 * middle + high, -1e-20))
    slope, offset = np.polyfit(starts - starts[0], lags, 1)
    return offset + slope * (starts - starts[0]), float(1e6 * slope)


def _left(heard: np.ndarray, references: np.ndarray, band: slice, size: int) -> tuple[float, bool]:
    """Echo over what the filter of the first half leaves of the second, dB; whether that filter only copies."""
    half = len(heard) // 2
    total = np.sum(power(references[:half]), axis=0)
    response = fft.irfft(np.sum(heard[:half] * np.conj(references[:half]), axis=0) / (total + 1e-6 * total.max()), size)
    response[SAMPLE_RATE // 4 : -FADE] = 0.0  # no echo path is longer than 250 ms
    left = heard[half:, band] - fft.rfft(response)[band] * references[half:, band]
    linear_db = float(decibels(np.sum(power(heard[half:, band])) / max(np.sum(power(left)), 1e-12)))
    largest = np.argmax(np.abs(response))
    there = np.sum(np.roll(response, 16 - largest)[:33] ** 2)  # an impulse of this band, 1 ms to each side
    return linear_db, bool(linear_db > 50.0 and there > 0.98 * np.sum(response**2))
