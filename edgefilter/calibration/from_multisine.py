"""Calibration by a sweep and multisines: a Profile that also knows what a linear path leaves of the robot, at three levels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.calibration.array import first
from edgefilter.calibration.calibrate import calibrate, checked, fan_psd
from edgefilter.calibration.checks import check_lengths, clipped_samples
from edgefilter.calibration.multisine import BLOCK, PERIOD, PERIODS, MultisineLaw, multisine_law, realisations
from edgefilter.calibration.sweep import (
    DRIFT_REACH,
    LATEST_DIRECT,
    LOW_HZ,
    STRETCHED_PPM,
    deconvolve,
    find_direct,
    smoothed,
    sweep_law,
)
from edgefilter.dsp.fourier import power
from edgefilter.dsp.fractional_delay import interpolate
from edgefilter.dsp.frames import decibels
from edgefilter.dsp.lag import correlation_near, highest, top
from edgefilter.dsp.psd import ROUNDING_PSD, total_power
from edgefilter.errors import CalibrationError
from edgefilter.profile.approximation import LinearApproximation
from edgefilter.profile.data import GRID_HZ, Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

LINE_HZ = SAMPLE_RATE / PERIOD
SMOOTHING_HZ = 30.0
"""Half the width over which lines are averaged at least: 30 lines, so that a density is good to 1 dB."""
CERTAIN = 3.0
"""Standard deviations of the noise's own power from which on a distortion is told from it."""
LEAST_SHARE = 0.1
"""The least share of the recorded power that the loudest multisines must explain; another sound explains none of it."""
DISTURBED_DB = 3.0
"""A warning is given where the noise while the multisines sound is further above the fan alone."""

Spectra = NDArray[np.complex128]


def calibrate_multisine(
    sweep_reference: Samples, sweep_recording: Samples, noise_recording: Samples, *, created: str = "", source: str = ""
) -> Profile:
    """Measure the robot's own voice at its microphone, and what of it no linear path explains.

    Parameters
    ----------
    sweep_reference : ndarray of float, shape (n,)
        The sound of `generate_multisine` as it was played. All three at 16 kHz, full scale +-1.
    sweep_recording, noise_recording, created, source
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
    reference, recordings, noises = checked(sweep_reference, sweep_recording, noise_recording)
    recording, noise = first(recordings), first(noises)
    law = multisine_law(reference)
    sweep = reference[: law.first]
    check_lengths(sweep_law(sweep), recording, noise)
    near = deconvolve(sweep, recording[: law.first + LATEST_DIRECT], fan_psd(noise), GRID_HZ, PERIOD)
    swept = recordings[..., : law.first + max(find_direct(near.response), 0)]
    profile = calibrate(sweep, swept.T, noises.T, created=created, source=source)
    approximation, warnings = approximate(profile, law, reference, recording)
    return replace(profile, approximation=approximation, warnings=(*profile.warnings, *warnings))


def approximate(
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
    lines = _Lines.of(played, part)
    found = lines.approximation()
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
    rough = [highest(correlation_near(spectrum, PERIOD, DRIFT_REACH))[0] for spectrum in cross]
    lags = [top(spectrum, PERIOD, lag) for spectrum, lag in zip(cross, rough, strict=True)]
    loud = len(lags) // 3
    return 1e6 * float(np.polyfit(BLOCK * np.arange(len(lags))[loud:], lags[loud:], 1)[0])


@dataclass(frozen=True, eq=False)
class _Lines:
    """Powers of the lines, summed over realisations, and of how many each is the sum; all (levels, lines)."""

    played: Array
    linear: Array
    noise: Array
    even: Array
    odd: Array
    measured_even: Array
    measured_odd: Array

    @classmethod
    def of(cls, played: Spectra, part: Samples) -> _Lines:
        """Of the played spectra (levels, realisations, lines) and their recording, aligned with them."""
        excited = realisations().excited
        odd_lines = np.arange(excited.shape[1]) % 2 == 1
        audible = np.arange(excited.shape[1]) * LINE_HZ >= LOW_HZ
        heard = _measured(part, played.shape[:2])
        mean = heard.mean(axis=2)
        noise = power(heard - mean[:, :, None]).sum(axis=2) / (PERIODS - 2)
        own = noise / (PERIODS - 1)
        x = played * excited
        energy = power(x).sum(axis=1)
        best = (mean * x.conj()).sum(axis=1) / np.maximum(energy, 1e-30)
        known = np.maximum(excited.sum(axis=0) - 1, 0)
        unexplained = np.where(excited, power(mean - best[:, None] * x), 0.0).sum(axis=1)
        unexplained -= known * own.mean(axis=1)
        silent = ~excited & audible
        between = ((power(mean) - own) * (silent & odd_lines)).sum(axis=1)
        return cls(
            played=energy,
            linear=power(best) * energy,
            noise=noise.sum(axis=1),
            even=((power(mean) - own) * (silent & ~odd_lines)).sum(axis=1),
            odd=unexplained + between,
            measured_even=np.broadcast_to((silent & ~odd_lines).sum(axis=0), energy.shape),
            measured_odd=np.broadcast_to(known + (silent & odd_lines).sum(axis=0), energy.shape),
        )

    def approximation(self) -> LinearApproximation:
        """Densities on the profile's grid; the linear part less what noise and distortion put into it."""
        every = np.full(self.played.shape, len(realisations().periods))
        odd, noise = _density(self.odd, 2 * self.measured_odd), _density(self.noise, every)
        counted = (self.played > 0).astype(float)
        added = (2 * odd + noise / (PERIODS - 1)) * _smooth(counted) / len(realisations().periods)
        linear = _density(self.linear, every) - added
        total, even = _density(self.played, every), _density(self.even, 2 * self.measured_even)
        level = decibels(np.array([total_power(psd) for psd in total]))
        least = decibels(CERTAIN * _chance(noise) / np.array([max(total_power(psd), 1e-30) for psd in linear]), 1e-10)
        densities = {"played": total, "linear": linear, "noise": noise, "even": even, "odd": odd}
        stored = {name: psd.astype(np.float32) for name, psd in densities.items()}
        return LinearApproximation(level_db=level, **stored, least_db=least)


def _density(total: Array, count: Array) -> Array:
    """Densities on GRID_HZ, full scale^2/Hz, from sums of |line|^2 (levels, lines) over so many lines each; (levels, 601)."""
    return 2.0 / PERIOD**2 / LINE_HZ * _smooth(total) / np.maximum(_smooth(count.astype(float)), 1e-12)


def _chance(noise: Array) -> Array:
    """Standard deviation of a distortion's power where there is noise of those densities (levels, 601) alone, (levels,).

    Of the sum over every other line of |line|^2 less its expectation, each the mean over all realisations.
    """
    lines = np.sum(noise**2, axis=1) * GRID_HZ[1] * LINE_HZ / 2
    return np.sqrt(lines / len(realisations().periods)) / (PERIODS - 1)


def _smooth(lines: Array) -> Array:
    """Mean over the lines around each frequency of GRID_HZ, (levels, 601)."""
    return smoothed(lines, GRID_HZ, LINE_HZ, SMOOTHING_HZ)


def _doubts(profile: Profile, found: LinearApproximation, part: Samples, ppm: float) -> list[str]:
    """What makes the approximation, or the sweep beside it, less than trustworthy."""
    texts = []
    clipped = clipped_samples(part)
    if clipped.size:
        texts.append(
            f"clipped: {clipped.size} samples while the multisines sound, which looks like distortion of the loudspeaker,"
            " in all bands; lower the playback volume or the microphone gain and calibrate again"
        )
    alone = max(total_power(profile.noise_psd), ROUNDING_PSD * SAMPLE_RATE / 2)
    louder = decibels(np.array([total_power(psd) for psd in found.noise]) / alone)
    if np.max(louder) > DISTURBED_DB:
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
