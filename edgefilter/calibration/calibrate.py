"""Calibration: from a recorded sweep and the fan alone, in one microphone or several, to a Profile."""

from __future__ import annotations

import numpy as np
import scipy
from scipy import fft

from edgefilter.calibration.checks import check_found, check_lengths, collect_warnings
from edgefilter.calibration.sweep import MIN_TAPS, Deconvolution, deconvolve, distortion_db, paper_response, sweep_law
from edgefilter.dsp.exchange import EQUAL
from edgefilter.dsp.frames import all_block_power, frames
from edgefilter.dsp.psd import GRID_FFT, hann, third_octave_bands
from edgefilter.dsp.resample import at_16_khz
from edgefilter.echo.model import EchoModel
from edgefilter.errors import CalibrationError, SignalError
from edgefilter.profile.array import ArrayCalibration
from edgefilter.profile.data import Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples, as_microphones, as_samples

MAX_TAPS = SAMPLE_RATE
"""Samples, 1 s: what is kept of the impulse response at most."""
APART_DB = 10.0
"""Difference of the fan's level to the median microphone's that equal microphones never have: on a real robot with four,
the three of its array agree within 1 dB and the fourth, of another kind, is 12 to 18 dB louder."""
FARTHEST = 32
"""Samples between the direct sound in two microphones of one robot: .7 m."""


def calibrate(
    sweep_reference: Samples,
    sweep_recording: Samples,
    noise_recording: Samples,
    *,
    created: str = "",
    source: str = "",
    sample_rate: int = SAMPLE_RATE,
) -> Profile:
    """Measure the robot's own voice at its microphone.

    Parameters
    ----------
    sweep_reference : ndarray of float, shape (n,)
        An exponential sweep as it was played, with silence around it (`generate_sweep`). Full scale +-1, as of
        all three.
    sweep_recording : ndarray of float, shape (m,) or (m, channels)
        What the microphone heard, on the same sample counter to within -2000 samples and 1.6 s; or two to eight
        microphones that share a clock.
    noise_recording : ndarray of float, shape (k,) or (k, channels)
        The fan alone, some seconds, in the same microphones.
    created, source : str
        Texts for the profile: when, and from what.
    sample_rate : int
        Of the three recordings; they are converted to 16 kHz.

    Returns
    -------
    Profile
        What makes it less than trustworthy stands in its `warnings`.

    Raises
    ------
    CalibrationError
        Where there is nothing to measure: the recording does not contain the sweep, is silent, far too short or not
        finite, or the reference is no exponential sweep.

    Notes
    -----
    Deconvolution by an exponential sweep, Farina (2000), harmonics apart as in Novak et al. (2015); the response of
    each frequency as in Li, Hindriks & Kunneman (2024), eq. (3) to (5).

    Examples
    --------
    >>> from edgefilter import generate_sweep
    >>> rng = np.random.default_rng(0)
    >>> sweep = generate_sweep()
    >>> recording = 0.5 * np.roll(sweep, 300) + 1e-4 * rng.standard_normal(sweep.size).astype(np.float32)
    >>> profile = calibrate(sweep, recording, 1e-4 * rng.standard_normal(64000).astype(np.float32))
    >>> profile.delay, round(float(profile.response[100]), 2)
    (300.0, 0.5)
    """
    reference, recordings, noises = checked(sweep_reference, sweep_recording, noise_recording, sample_rate)
    recording, noise = first(recordings), first(noises)
    law = sweep_law(reference)
    check_lengths(law, recording, noise)
    noise_psd = fan_psd(noise)
    result = deconvolve(reference, recording, noise_psd)
    check_found(result)
    path = impulse_response(result, result.direct)
    snr = band_snr_db(result, path)
    warnings = collect_warnings(law, reference, recording, noise, result, path, snr)
    array = None
    if recordings.ndim > 1:
        for at in np.flatnonzero(~recordings.any(axis=1)):
            silent = f"channel {at} of the sweep recording is silent, every sample 0"
            raise CalibrationError(f"{silent}: choose the microphones with --mic-channels")
        results = [deconvolve(reference, *of) for of in zip(recordings[1:], map(fan_psd, noises[1:]))]
        responses = np.zeros((len(results), MAX_TAPS), np.float32)
        for row, other in zip(responses, results):
            further = impulse_response(other, result.direct)
            row[: further.size] = further
        array = ArrayCalibration(responses[:, : max(path.size, MIN_TAPS)], cross_density(noises))
        warnings += doubts(noises, [result, *results])
    return Profile(
        echo=EchoModel(path),
        delay=float(result.direct),
        response=paper_response(reference, recording, noise, result.direct),
        noise_psd=noise_psd,
        band_hz=third_octave_bands(),
        band_snr_db=snr,
        distortion_db=distortion_db(result, law),
        warnings=tuple(warnings),
        created=created,
        source=source,
        array=array,
    )


def checked(
    reference: Samples, recording: Samples, noise: Samples, sample_rate: int
) -> tuple[Samples, Samples, Samples]:
    """The recordings of a calibration at 16 kHz as float32, of an array the latter two (microphones, n); CalibrationError for others."""
    reference, recording, noise = (at_16_khz(x, sample_rate) for x in (reference, recording, noise))
    try:
        found = (
            as_samples(reference, "the sweep reference"),
            as_microphones(recording, "the sweep recording"),
            as_microphones(noise, "the noise recording"),
        )
    except SignalError as error:
        raise CalibrationError(str(error)) from None
    counts = [1 if one.ndim == 1 else len(one) for one in found[1:]]
    if counts[0] != counts[1]:
        raise CalibrationError(
            f"the sweep recording has {counts[0]} channels and the noise recording {counts[1]}, expected the same"
            " microphones in both"
        )
    return found


def first(recordings: Samples) -> Samples:
    """The first microphone of recordings (n,) or (microphones, n), (n,)."""
    return recordings if recordings.ndim == 1 else recordings[0]


def fan_psd(noise: Samples) -> Samples:
    """Welch's PSD (601,) float32, one-sided, full scale^2/Hz, on GRID_HZ: Hann frames of 1200 samples, half overlapping."""
    return scipy.signal.welch(noise, SAMPLE_RATE, nperseg=GRID_FFT, detrend=False)[1].astype(np.float32)


def impulse_response(result: Deconvolution, direct: int) -> Samples:
    """From PRE_ROLL before the direct sound to where the decay has sunk into the fan, (MIN_TAPS to MAX_TAPS,) float32.

    The knee is the first 20 ms in which the response is not 3 dB above what the fan leaves there. It is kept to 50 ms
    beyond, and faded by half a cosine from the knee (at most the last quarter where there is none) to the end.
    """
    path = result.cut(direct - PRE_ROLL, MAX_TAPS)
    block = SAMPLE_RATE // 50
    energy = block * all_block_power(path, block)
    floor = block * 2 * result.noise(1.0).sum() / result.response.size
    below = np.flatnonzero(energy[2:] < 2 * floor)
    knee = int(below[0] + 2) * block if below.size else MAX_TAPS
    length = int(np.clip(knee + SAMPLE_RATE // 20, MIN_TAPS, MAX_TAPS))
    fade = length - min(max(knee, length // 4), 3 * length // 4) if knee < length else length // 4
    path = path[:length].copy()
    path[-fade:] *= np.cos(np.linspace(0, np.pi / 2, fade)) ** 2
    return path.astype(np.float32)


def band_snr_db(result: Deconvolution, path: Samples) -> Array:
    """The energy of the sweep's coherent part in each third octave over the fan's in a window as long as the response, (B,) dB.

    The coherent part is what the impulse response predicts, less what the fan put into it; limited to -20 to 120 dB.
    """
    energy = result.spectrum(path) * result.source_energy
    fan = path.size * result.noise_psd
    own = fan * (result.source_energy / (result.source_energy + result.regularisation + 1e-30)) ** 2
    levels = []
    for low, high in third_octave_bands():
        inside = (result.frequencies >= low) & (result.frequencies < high)
        ratio = (energy - own)[inside].sum() / fan[inside].sum()
        levels.append(10 * np.log10(np.clip(ratio, 1e-2, 1e12)))
    return np.array(levels)


def cross_density(noises: Samples) -> Samples:
    """Spectral covariance of noises (microphones, n), as ArrayCalibration.noise, (601, microphones, microphones, 2) float32."""
    window = hann(GRID_FFT)
    spectra = fft.rfft([frames(one, GRID_FFT, GRID_FFT // 2) * window for one in noises.astype(np.float64)])
    found = np.einsum("itk,jtk->kij", spectra, spectra.conj()) / (spectra.shape[1] * SAMPLE_RATE * np.sum(window**2))
    found[1:-1] *= 2.0
    return np.stack((found.real, found.imag), axis=-1).astype(np.float32)


def doubts(noises: Samples, results: list[Deconvolution]) -> list[str]:
    """What is doubtful about microphones beside one another: noises (microphones, n), and what was deconvolved of each."""
    found = []
    power = np.mean(np.square(noises, dtype=np.float64), axis=1)
    level = 10 * np.log10(power + 1e-20)
    for at, apart in enumerate(level - np.median(level)):
        if abs(apart) > APART_DB:
            how = f"{abs(apart):.0f} dB {'louder' if apart > 0 else 'softer'}"
            found.append(
                f"channel {at}: the fan is {how} in it than in the others: another gain, or another kind of microphone?"
            )
    for at, result in enumerate(results):
        lag = result.direct - results[0].direct
        if abs(lag) > FARTHEST:
            late = f"hears the robot {lag} samples after channel 0"
            found.append(f"channel {at}: {late}; another converter, or processed?")
    found += [
        f"channel {j}: the same sound as channel {i}; leave one of them out"
        for j in range(len(noises))
        for i in range(j)
        if np.mean(np.square(noises[i] - noises[j], dtype=np.float64)) < EQUAL * max(power[i], 1e-20)
    ]
    return found
