"""Errors and warnings of a calibration; each warning names the bands that it is about."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.calibration.sweep import EARLIEST_DIRECT, LATEST_DIRECT, MIN_TAPS, Deconvolution, SweepLaw, deconvolve
from edgefilter.dsp.fourier import power
from edgefilter.dsp.frames import block_power, blocks, stretch
from edgefilter.dsp.psd import frequencies, hann, third_octave_bands
from edgefilter.errors import CalibrationError
from edgefilter.profile.data import GRID_HZ, LOW_SNR_DB
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

SPEECH_HZ = (110.0, 7100.0)
"""A warning is about bands that end above the one and begin below the other; small loudspeakers radiate nothing beyond."""


def check_lengths(law: SweepLaw, recording: Samples, noise: Samples) -> None:
    """Raise CalibrationError for recordings that are too short or silent."""
    if noise.size < SAMPLE_RATE // 2:
        raise CalibrationError(
            f"the noise recording is {noise.size / SAMPLE_RATE:.2f} s long, expected at least 0.5 s of the fan alone"
        )
    middle = law.time(1000.0)
    if recording.size < middle:
        raise CalibrationError(
            f"the sweep recording is {recording.size / SAMPLE_RATE:.2f} s long and ends before the sweep reaches 1 kHz,"
            f" expected at least {law.stop / SAMPLE_RATE:.2f} s: record the whole sweep"
        )
    if not recording.any():
        raise CalibrationError("the sweep recording is silent, every sample 0: is the microphone muted?")


def check_found(result: Deconvolution) -> None:
    """Raise CalibrationError unless the deconvolved response has one clear arrival.

    Its peak over its root mean square: 30 to 160 measured where there is the sweep, down to 15 dB below the fan; 2 to 10
    for speech, noise, tones and other sweeps.
    """
    nearby = result.cut(EARLIEST_DIRECT, LATEST_DIRECT - EARLIEST_DIRECT)
    contrast = abs(result.response[result.direct]) / max(float(np.sqrt(np.mean(nearby**2))), 1e-30)
    if not contrast > 18.0:
        raise CalibrationError(
            f"the sweep recording does not contain the sweep: the best match stands out {contrast:.0f} times, expected"
            " at least 18; is it the right file, and was the robot loud enough?"
        )


def collect_warnings(
    law: SweepLaw,
    reference: Samples,
    recording: Samples,
    noise: Samples,
    result: Deconvolution,
    path: Samples,
    snr: Array,
) -> list[str]:
    """All warnings about a calibration, the gravest first."""
    direct, level = result.direct, float(np.max(np.abs(recording)))
    found, clipped = [], clipped_samples(recording)
    if clipped.size:
        hz = law.frequency(clipped - direct)
        low, high = np.clip(np.percentile(hz, [2, 98]), law.low_hz, law.high_hz)
        found.append(
            f"clipped: {clipped.size} samples at {level:.2f} of full scale, {low:.0f}-{high:.0f} Hz; "
            "lower the playback volume or the microphone gain and calibrate again"
        )
    rung_out = direct + SAMPLE_RATE // 5
    missing = law.stop + rung_out - recording.size
    if missing > 0:
        edge = min(float(law.frequency(recording.size - rung_out)), law.high_hz)
        found.append(
            f"too short: the recording ends {missing / SAMPLE_RATE:.2f} s early, {edge:.0f}-{law.high_hz:.0f} Hz is missing"
            " or cut off"
        )
    found += low_snr(snr)
    if level < 0.01:
        peak = f"{20 * np.log10(level):.0f} dB of full scale"
        found.append(f"too quiet: the recording peaks at {peak}, expected above -40 dB, in all bands")
    found += disturbed(law, reference, recording, noise, result)
    energy = max(float(np.sum(path.astype(np.float64) ** 2)), 1e-30)
    lost = float(np.sum(result.cut(direct - PRE_ROLL - 480, 480) ** 2)) / energy
    if lost >= 0.003:
        found.append(
            f"{10 * np.log10(lost):.0f} dB of the robot's voice, in all bands, arrives more than {PRE_ROLL} samples before"
            " its strongest part and is not in the impulse response"
        )
    return found + doubtful_noise(reference, noise)


def clipped_samples(recording: Samples) -> NDArray[np.intp]:
    """Indices of samples (n,) at full scale or on a flat top below it; none where they are fewer than 8."""
    size = np.abs(recording)
    level = float(size.max())
    top = size >= 0.999 if level >= 0.999 else size > 0.995 * level
    still = np.abs(np.diff(recording)) < 2e-5
    flat = np.zeros(size.size, bool)
    run = still[:-2] & still[1:-1] & still[2:] & top[:-3]
    for k in range(4):
        flat[k : size.size - 3 + k] |= run
    found = np.flatnonzero(flat | (size >= 0.9999))
    return found if found.size >= 8 else found[:0]


def low_snr(snr: Array) -> list[str]:
    """Bands of speech in which the fan hides the sweep."""
    bands = third_octave_bands()
    inside = (bands[:, 1] > SPEECH_HZ[0]) & (bands[:, 0] < SPEECH_HZ[1])
    low = np.flatnonzero(inside & (snr < LOW_SNR_DB))
    if not low.size:
        return []
    runs = np.split(low, np.flatnonzero(np.diff(low) > 1) + 1)
    parts = ", ".join(f"{bands[run[0], 0]:.0f}-{bands[run[-1], 1]:.0f} Hz ({snr[run].min():.0f} dB)" for run in runs)
    return [f"low signal-to-noise ratio, below {LOW_SNR_DB:.0f} dB, in {parts}: play the sweep louder or longer"]


def disturbed(
    law: SweepLaw, reference: Samples, recording: Samples, noise: Samples, result: Deconvolution
) -> list[str]:
    """Something else in a sweep's recording: quarter seconds in which neither the path nor its harmonics explain the sound.

    What remains exceeds the fan by 10 dB, a sixth of the explained power there, and the loudest quarter second less 25 dB.
    """
    early = int(law.lead(5.5))
    shift = result.direct - early
    predicted = scipy.signal.oaconvolve(reference.astype(np.float64), result.cut(shift, early + MIN_TAPS))
    own = stretch(predicted, -shift, recording.size - shift)
    block = SAMPLE_RATE // 4
    rest, explained = block_power(recording - own, block), block_power(own, block)
    least = max(10 * float(np.mean(noise.astype(np.float64) ** 2)), explained.max() * 10**-2.5, 1e-9)
    bad = np.flatnonzero(rest > np.maximum(explained / 6, least))
    if not bad.size:
        return []
    hz = np.clip(law.frequency(bad * block + block / 2 - result.direct), law.low_hz, law.high_hz)
    return [
        f"something else than the sweep sounds in {bad.size * 0.25:.2f} s of the recording (from {bad[0] * 0.25:.2f} s"
        f" on), while the sweep was at {hz.min():.0f}-{hz.max():.0f} Hz; calibrate again in silence"
    ]


def doubtful_noise(reference: Samples, noise: Samples) -> list[str]:
    """A noise recording that is short, silent, unsteady, or contains the robot."""
    texts = []
    if noise.size < 2 * SAMPLE_RATE:
        texts.append(
            f"the noise recording is only {noise.size / SAMPLE_RATE:.1f} s long, expected 5 s: the fan is known"
            " roughly, in all bands"
        )
    if not noise.any():
        texts.append("the noise recording is silent, every sample 0: signal-to-noise ratios mean nothing, in all bands")
        return texts
    again = deconvolve(reference, noise, np.full(GRID_HZ.size, 1e-10))
    nearby = np.abs(again.cut(EARLIEST_DIRECT, LATEST_DIRECT - EARLIEST_DIRECT))
    if nearby.max() > 18.0 * np.sqrt(np.mean(nearby**2)):
        texts.append(
            "the noise recording contains the sweep: record the fan while the robot is silent; noise is overstated"
            " in all bands"
        )
        return texts
    shape, share, high = _unsteady(noise)
    if shape > 6.0:
        texts.append(
            f"the noise recording is not steady: {share:.0f} % of it stands out, by up to {shape:.0f} dB around"
            f" {high:.0f} Hz; a voice or a bang? record the fan alone"
        )
    return texts


def _unsteady(noise: Samples) -> tuple[float, float, float]:
    """How far the loudest 100 ms stand out of an octave's median, dB; percent of times above 3 dB; the octave's centre, Hz."""
    block = SAMPLE_RATE // 10
    spectra = power(np.fft.rfft(blocks(noise, block) * hann(block), axis=1))
    hz = frequencies(spectra.shape[1])
    worst = (0.0, 0.0, 0.0)
    for centre in (250.0, 500.0, 1000.0, 2000.0, 4000.0):
        level = 10 * np.log10(spectra[:, (hz >= centre / 1.414) & (hz < centre * 1.414)].sum(axis=1) + 1e-14)
        above = level - np.median(level)
        if above.max() > worst[0]:
            worst = (float(above.max()), 100 * float(np.mean(above > 3.0)), centre)
    return worst
