"""Calibration by a sweep and then random-phase multisines at several levels: a Profile that also knows what no linear path explains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from edgefilter.calibration.calibrate import calibrate, checked, fan_psd, first
from edgefilter.calibration.checks import check_lengths, clipped_samples
from edgefilter.calibration.sweep import (
    DRIFT_REACH,
    LATEST_DIRECT,
    LOW_HZ,
    STRETCHED_PPM,
    deconvolve,
    generate_sweep,
    smoothed,
    sweep_law,
)
from edgefilter.dsp.fourier import power
from edgefilter.dsp.fractional_delay import interpolate
from edgefilter.dsp.frames import decibels
from edgefilter.dsp.lag import correlation_near, highest, top
from edgefilter.dsp.psd import ROUNDING_PSD, total_power
from edgefilter.errors import CalibrationError
from edgefilter.profile.approximation import CLEARLY_DB, LinearApproximation
from edgefilter.profile.data import GRID_HZ, Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

PERIOD = 8192
"""Samples (0.51 s): the path has died away within one, and its lines are 2 Hz apart."""
LINE_HZ = SAMPLE_RATE / PERIOD
PERIODS = 3
"""Of each realisation: in the first the path swings in, the others are measured."""
BLOCK = PERIOD * PERIODS
REALISATIONS = 4
LEVELS_DB = (-12.0, -6.0, 0.0)
"""Of the multisines, the softest first; all realisations at each."""
BAND_HZ = (80.0, 7000.0)
"""Above, speech has nothing that counts, and no clock that drifts could be straightened."""
SPEECH_DB = (-376.44, 465.439, -157.745, 16.7124)
"""Density of average speech, dB: coefficients of the powers of lg f, f in Hz, 100 to 8000 (ITU-T P.50, 1999, 2.1)."""
SWEEP_PART = 0.5
"""Peak of the sweep over that of the loudest multisines; its mean power is the higher one all the same."""
GROUP = 4
"""Of so many odd lines in a row one, drawn at random, is left out."""
SMOOTHING_HZ = 30.0
"""Half the width over which lines are averaged at least: 30 lines, so that a density is good to 1 dB."""
OVER_CHANCE = 3.0
"""A distortion counts from so many standard deviations of the noise's power on: less may be the noise."""
LEAST_SHARE = 0.1
"""The least share of the recorded power that the loudest multisines must explain; another sound explains none of it."""

Spectra = NDArray[np.complex128]


@lru_cache(maxsize=1)
def realisations() -> tuple[Array, NDArray[np.bool_]]:
    """Odd-random multisines: only odd lines, so that an even distortion falls between them, some left out for the odd one.

    Returns one period of each (REALISATIONS, PERIOD), peak at most 1, all of the same power, and which lines each has
    (., PERIOD / 2 + 1). Random phases and lines differ (Pintelon & Schoukens 2012, sec. 3.4 and 4.3).
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
    return periods / np.max(np.abs(periods)), excited


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
    levels = [10 ** (level / 20) * np.tile(realisations()[0], PERIODS).ravel() for level in LEVELS_DB]
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
        return self.first + BLOCK * np.arange(len(LEVELS_DB) * REALISATIONS).reshape(-1, REALISATIONS)


def multisine_law(reference: Samples) -> MultisineLaw:
    """Recognise the sound of generate_multisine() at any level and place; raise CalibrationError where there is none."""
    pattern = generate_multisine(1.0, 0.0, 0.0).astype(np.float64)
    energy = float(np.sum(reference.astype(np.float64) ** 2))
    if reference.size >= pattern.size and energy > 0:
        match = signal.correlate(reference.astype(np.float64), pattern, "valid", "fft")
        start = int(np.argmax(np.abs(match)))
        if abs(match[start]) > 0.9 * np.sqrt(energy * np.sum(pattern**2)):
            return MultisineLaw(start, start + pattern.size - len(LEVELS_DB) * REALISATIONS * BLOCK)
    seconds = f"{reference.size / SAMPLE_RATE:.1f} s long" if reference.any() else "silent"
    raise CalibrationError(
        f"the sweep reference ({seconds}) is not the sweep with multisines of {pattern.size / SAMPLE_RATE:.1f} s:"
        " play the one that 'calibrate --multisine --excitation FILE' writes, or leave --multisine out"
    )


def calibrate_multisine(
    sweep_reference: Samples,
    sweep_recording: Samples,
    noise_recording: Samples,
    *,
    created: str = "",
    source: str = "",
    sample_rate: int = SAMPLE_RATE,
) -> Profile:
    """Measure the robot's own voice at its microphone, and what of it no linear path explains.

    Parameters
    ----------
    sweep_reference : ndarray of float, shape (n,)
        The sound of `generate_multisine` as it was played. Full scale +-1, as of all three.
    sweep_recording, noise_recording, created, source, sample_rate
        As of `calibrate`.

    Returns
    -------
    Profile
        That of `calibrate` for the sweep, and its `approximation`.

    Raises
    ------
    CalibrationError
        As of `calibrate`; also where the reference is another sound, or the recording does not hold the multisines.

    Notes
    -----
    The robust method of Pintelon & Schoukens (2012), "System Identification: A Frequency Domain Approach", sec. 4.3.
    Per level: differences between the periods of one realisation are noise; what is the same in all of its periods, but
    not explained by the mean over all realisations, is distortion of odd order, and so is what falls on odd lines that
    were not played; what falls on even lines, none of which is played, is distortion of even order. Clocks that drift
    are straightened first.

    Examples
    --------
    >>> from edgefilter import generate_multisine
    >>> rng = np.random.default_rng(0)
    >>> played = generate_multisine()
    >>> heard = (played + 0.2 * played**2 + 1e-4 * rng.standard_normal(played.size)).astype(np.float32)
    >>> profile = calibrate_multisine(played, heard, 1e-4 * rng.standard_normal(64000).astype(np.float32))
    >>> even, odd = (profile.approximation.over_linear_db(name)[-1] for name in ("even", "odd"))
    >>> bool(-30 < even < -20 and odd < -50)
    True
    """
    reference, recordings, noises = checked(sweep_reference, sweep_recording, noise_recording, sample_rate)
    recording, noise = first(recordings), first(noises)
    law = multisine_law(reference)
    sweep = reference[: law.first]
    check_lengths(sweep_law(sweep), recording, noise)
    near = deconvolve(sweep, recording[: law.first + LATEST_DIRECT], fan_psd(noise), PERIOD)
    swept = recordings[..., : law.first + max(near.direct, 0)]
    profile = calibrate(sweep, swept.T, noises.T, created=created, source=source)
    approximation, warnings = _approximate(profile, law, reference, recording)
    return replace(profile, approximation=approximation, warnings=(*profile.warnings, *warnings))


def _approximate(
    profile: Profile, law: MultisineLaw, reference: Samples, recording: Samples
) -> tuple[LinearApproximation, list[str]]:
    """What the multisines of a recording (m,) tell beyond the profile that its sweep gave, and what is doubtful about it."""
    delay = round(profile.delay) - PRE_ROLL
    if recording.size < law.stop + delay:
        raise CalibrationError(
            f"the sweep recording is {recording.size / SAMPLE_RATE:.1f} s long and ends before the multisines do,"
            f" expected at least {(law.stop + delay) / SAMPLE_RATE:.1f} s: record all of the sound"
        )
    played = fft.rfft(reference[law.blocks()[..., None] + PERIOD + np.arange(PERIOD)].astype(np.float64))
    part = recording[law.first + delay : law.stop + delay]
    ppm = _drift_ppm(profile, played, part)
    at = np.arange(part.size) + law.first
    part = interpolate(recording, delay + at + 1e-6 * ppm * (at - law.first / 2))
    found = _approximation(played, part)
    loudest = part[part.size * 2 // 3 :].astype(np.float64)
    share = total_power(found.linear[-1]) / max(float(np.mean(loudest**2)), 1e-30)
    if not share > LEAST_SHARE:
        raise CalibrationError(
            f"the sweep recording holds the sweep but not the multisines behind it: they explain {100 * share:.0f} % of"
            f" what is heard there, expected at least {100 * LEAST_SHARE:.0f} %; is it the recording of this reference?"
        )
    return found, _doubts(profile, found, part, ppm)


def _measured(part: Samples, blocks: tuple[int, int]) -> Spectra:
    """Spectra of the periods that are measured, (levels, realisations, PERIODS - 1, lines)."""
    return fft.rfft(part.astype(np.float64).reshape(*blocks, PERIODS, PERIOD)[:, :, 1:])


def _drift_ppm(profile: Profile, played: Spectra, part: Samples) -> float:
    """By how many ppm the recording's clock is the faster: a line through the lags of the multisines behind the sweep's path."""
    path = fft.rfft(profile.echo.impulse_response[:PERIOD].astype(np.float64), PERIOD)
    heard = _measured(part, played.shape[:2]).mean(axis=2)
    cross = (heard * np.conj(played * path)).reshape(-1, path.size)
    lags = [top(line, PERIOD, highest(correlation_near(line, PERIOD, DRIFT_REACH))[0]) for line in cross]
    loud = len(lags) // 3
    return 1e6 * float(np.polyfit(BLOCK * np.arange(len(lags))[loud:], lags[loud:], 1)[0])


def _approximation(played: Spectra, part: Samples) -> LinearApproximation:
    """What the multisines, of spectra (levels, realisations, lines), and a recording aligned with them tell, on the profile's grid.

    Powers of lines are summed over the realisations. The linear part is less what noise and distortion put into it.
    """
    _, excited = realisations()
    every = np.full(excited.shape[1], REALISATIONS)
    odd_lines = np.arange(every.size) % 2 == 1
    silent = ~excited & (np.arange(every.size) * LINE_HZ >= LOW_HZ)
    heard = _measured(part, played.shape[:2])
    mean = heard.mean(axis=2)
    changing = power(heard - mean[:, :, None]).sum(axis=2) / (PERIODS - 2)
    own = changing / (PERIODS - 1)
    x = played * excited
    energy = power(x).sum(axis=1)
    best = (mean * x.conj()).sum(axis=1) / np.maximum(energy, 1e-30)
    known = np.maximum(excited.sum(axis=0) - 1, 0)
    unexplained = np.where(excited, power(mean - best[:, None] * x), 0.0).sum(axis=1)
    unexplained -= known * own.mean(axis=1)
    between = ((power(mean) - own) * (silent & odd_lines)).sum(axis=1)
    odd = _density(unexplained + between, 2 * (known + (silent & odd_lines).sum(axis=0)))
    even = _density(((power(mean) - own) * (silent & ~odd_lines)).sum(axis=1), 2 * (silent & ~odd_lines).sum(axis=0))
    noise, total = _density(changing.sum(axis=1), every), _density(energy, every)
    counted = (energy > 0).astype(float)
    added = (2 * odd + noise / (PERIODS - 1)) * _smooth(counted) / REALISATIONS
    linear = _density(power(best) * energy, every) - added
    level = decibels(np.array([total_power(psd) for psd in total]))
    # standard deviation that noise alone gives the power of a distortion: |line|^2, averaged over all realisations, less what is
    # expected of the noise, summed over every second line
    chance = np.sqrt(np.sum(noise**2, axis=1) * GRID_HZ[1] * LINE_HZ / 2 / REALISATIONS) / (PERIODS - 1)
    least = decibels(OVER_CHANCE * chance / np.array([max(total_power(psd), 1e-30) for psd in linear]), 1e-10)
    densities = {"played": total, "linear": linear, "noise": noise, "even": even, "odd": odd}
    stored = {name: psd.astype(np.float32) for name, psd in densities.items()}
    return LinearApproximation(level_db=level, **stored, least_db=least)


def _density(total: Array, count: Array) -> Array:
    """Densities on GRID_HZ, full scale^2/Hz, from sums of |line|^2 (levels, lines) over so many lines (lines,); (levels, 601)."""
    return 2.0 / PERIOD**2 / LINE_HZ * _smooth(total) / np.maximum(_smooth(count.astype(float)), 1e-12)


def _smooth(lines: Array) -> Array:
    """Mean over the lines (..., lines) around each frequency of GRID_HZ, (..., 601)."""
    return smoothed(lines, GRID_HZ, LINE_HZ, SMOOTHING_HZ)


def _doubts(profile: Profile, found: LinearApproximation, part: Samples, ppm: float) -> list[str]:
    """What makes the approximation, or the sweep beside it, less than trustworthy."""
    texts = []
    clipped = clipped_samples(part)
    if clipped.size:
        texts.append(
            f"clipped: {clipped.size} samples while the multisines sound: in all bands this would be taken for distortion of the"
            " loudspeaker; lower the playback volume or the microphone gain and calibrate again"
        )
    alone = max(total_power(profile.noise_psd), ROUNDING_PSD * SAMPLE_RATE / 2)
    louder = decibels(np.array([total_power(psd) for psd in found.noise]) / alone)
    if np.max(louder) > CLEARLY_DB:
        texts.append(
            f"something else than the multisines sounds beside them, {np.max(louder):.0f} dB above the fan, in all bands;"
            " calibrate again in silence"
        )
    if abs(ppm) > STRETCHED_PPM:
        texts.append(
            f"the clocks of player and recorder are {abs(ppm):.0f} ppm apart: taken out of the multisines, but the sweep's"
            " path is smeared, in all bands; play and record with one device"
        )
    return texts
