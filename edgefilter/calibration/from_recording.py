"""A provisional profile without a calibration: the path and the fan as one recording of the robot shows them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import binary_closing, uniform_filter1d

from edgefilter.alignment.belief import believe, find_lag
from edgefilter.calibration.sweep import DRIFT_REACH
from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.fractional_delay import delayed, interpolate
from edgefilter.dsp.frames import SILENT, all_block_power, block_power, decibels, frames
from edgefilter.dsp.lag import correlation_near, flat_cross
from edgefilter.dsp.psd import ROUNDING_PSD, periodograms, third_octave_bands
from edgefilter.dsp.resample import at_16_khz
from edgefilter.echo.effects.catalogue import EFFECTS
from edgefilter.echo.measurement import whiten
from edgefilter.echo.model import EchoModel
from edgefilter.echo.recording import BLOCK, fitted_blocks, paired
from edgefilter.echo.wiener import fit_filter
from edgefilter.errors import SignalError
from edgefilter.profile.approximation import CLEARLY_DB
from edgefilter.profile.data import DISTORTION_ORDERS, GRID_FFT, GRID_HZ, PROVISIONAL, Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples, expect_positive

TAIL_S = 0.3


@dataclass(frozen=True)
class PathFit:
    """How a path, a drift and the fan are read off a recording. Raises UsageError for what is not above 0."""

    taps: int = 4096
    """Of the path, 256 ms: as long as the first 40 dB of a decay of `decays_s`."""
    reach: int = 512
    """Samples ahead of the highest correlation in which the direct sound is looked for."""
    decays_s: tuple[float, ...] = (0.15, 0.4)
    """Reverberation times that the penalty on the taps supposes; the one that predicts best is kept."""
    moment: int = SAMPLE_RATE // 20
    """Samples over which a disturbance is averaged; the fit gives less weight to what is disturbed."""
    others_db: float = 6.0
    """How far above the robot something is that is not the robot's."""
    most_ppm: float = 400.0
    """Largest drift that is looked for."""
    step_ppm: float = 2.0
    """Step of the drifts that are tried: 2 ppm move a lag by one sample in half a minute."""
    drift_gain: float = 1.1
    """Least ratio of the correlation along a sloping line to that along a level one for a drift to be believed."""
    upsampled: int = 4
    """Oversampling of the correlation, so that a line can be followed in quarters of a sample."""
    least_frames: int = 8
    """Of silence: with fewer the quietest frames stand in for it."""

    def __post_init__(self) -> None:
        expect_positive(asdict(self))


FIT = PathFit()


def self_calibrate(recording: Samples, reference: Samples, *, sample_rate: int = SAMPLE_RATE) -> Profile:
    """Make a provisional profile from a recording of the robot alone, where there is no calibration.

    Parameters
    ----------
    recording : ndarray of float, shape (n,)
        The robot at its microphone, full scale +-1.
    reference : ndarray of float, shape (m,)
        What it said, as sent to the loudspeaker.
    sample_rate : int
        Of both; they are converted to 16 kHz.

    Returns
    -------
    Profile
        Path and fan as this recording shows them; its `warnings` say what that cannot tell.

    Raises
    ------
    SignalError
        Where the recording does not contain the reference, or too little of it.

    Notes
    -----
    The path is a regularised least-squares filter on every other half second, those that a diagnosis fits on, so that
    the others say how well it predicts. Samples weigh the less the more the first fit leaves of them (iteratively
    reweighted least squares, Huber 1981), so that a talker does not bend it. The fan is what the robot's silences hold.
    Stationary linear effects and the fan's are in it at their neutral values, so that no search claims them: without a
    calibration nothing tells that the fan has changed.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> heard = 0.4 * np.roll(said, 300) + 1e-3 * rng.standard_normal(80_000).astype(np.float32)
    >>> self_calibrate(heard, said).delay
    300.0
    """
    y, x = paired(at_16_khz(recording, sample_rate), at_16_khz(reference, sample_rate))
    believed = believe(y, x)
    lag = find_lag(y, x, believed)
    ppm, behind = find_drift(y, delayed(x, lag))
    lag += behind
    psd, seconds = fan_in_silences(y, silences(delayed(x, lag)))
    target = whiten(y, psd)
    fit = fitted_blocks(y.size).astype(np.float32)
    sound = whiten(_drifting(delayed(x, lag - FIT.reach), ppm), psd)
    rough = fit_filter(sound, target, fit * disturbance(target), 2 * FIT.reach, 0, np.full(2 * FIT.reach, 1e-2))
    delay = lag - FIT.reach + int(np.argmax(np.abs(rough)))
    weights = fit * disturbance(target - filtered(sound, rough, 0))
    sound = whiten(_drifting(delayed(x, delay - PRE_ROLL), ppm), psd)
    path = fit_path(sound, target, weights, float(np.square(rough).max()))
    predicted = filtered(sound, path, 0)
    _check_learned(target, predicted, fit, delay, ppm, believed.missing)
    echo = EchoModel(path.astype(np.float32))
    for effect in EFFECTS:  # those that come with the package: whoever loads the profile knows no others
        if effect.absorbed or effect.stage == "noise":
            echo = echo.with_effect(effect.name, {})
    warnings = tuple(_warnings(seconds, others(target, predicted)))
    return replace(profile_of(echo, delay, psd, predicted), warnings=warnings, source=PROVISIONAL)


def profile_of(echo: EchoModel, delay: float, noise_psd: Samples, predicted: Samples) -> Profile:
    """The profile of a path that speech has shown, which tells no distortion; predicted: (n,), what it makes of it, whitened."""
    bands, snr = bands_over_fan(predicted)
    return Profile(
        echo=echo,
        delay=float(delay),
        response=np.abs(fft.rfft(echo.impulse_response, 16 * GRID_FFT))[::16].astype(np.float32),
        noise_psd=noise_psd,
        band_hz=bands,
        band_snr_db=snr,
        distortion_db=np.zeros(len(DISTORTION_ORDERS)),
    )


def _drifting(x: Samples, ppm: float) -> Samples:
    """Samples x (n,), read at a clock that is ppm faster."""
    n = np.arange(x.size)
    return interpolate(x, n + 1e-6 * ppm * n) if ppm else x


def find_drift(recording: Samples, reference: Samples) -> tuple[float, int]:
    """Fit the lag of recording (n,) behind reference (n,) by a line over time: drift in ppm, and the first lag in samples.

    Of the lines of up to FIT.most_ppm the one with the largest sum of whitened cross-correlations of windows of 1 s; 0 ppm
    where that sum is less than FIT.drift_gain times the one without a drift. Lags of up to DRIFT_REACH samples.
    """
    size, part = 4 * SAMPLE_RATE, slice(2 * SAMPLE_RATE, 3 * SAMPLE_RATE)
    padded = np.pad(reference, (2 * SAMPLE_RATE, 2 * SAMPLE_RATE))
    starts = np.arange(0, recording.size - SAMPLE_RATE + 1, SAMPLE_RATE // 2)
    reach = DRIFT_REACH * FIT.upsampled
    rows = np.zeros((starts.size, 2 * reach + 1))
    for row, start in zip(rows, starts, strict=True):
        heard = np.zeros(size)
        heard[part] = recording[start : start + SAMPLE_RATE]
        cross = flat_cross(padded[start : start + size], heard, size)
        row[:] = correlation_near(cross, FIT.upsampled * size, reach)
    grid = np.arange(-FIT.most_ppm, FIT.most_ppm + FIT.step_ppm, FIT.step_ppm)
    middles = starts + SAMPLE_RATE / 2
    twice, width, sums = np.hstack((rows, rows)), rows.shape[1], np.zeros((grid.size, rows.shape[1]))
    for line, ppm in zip(sums, grid, strict=True):
        moves = np.round(-ppm * 1e-6 * middles * FIT.upsampled).astype(int)
        for row, at in zip(twice, moves % width, strict=True):
            line += row[at : at + width]
    np.abs(sums, out=sums)
    heights = sums.max(axis=1)
    best = int(np.argmax(heights))
    if heights[best] < FIT.drift_gain * heights[grid.size // 2]:
        best = grid.size // 2
    return float(grid[best]), round((int(np.argmax(sums[best])) - reach) / FIT.upsampled)


def silences(reference: Samples) -> NDArray[np.bool_]:
    """Where an aligned reference (n,) is silent and has been for TAIL_S, (n,) bool."""
    block = SAMPLE_RATE // 10
    level = all_block_power(reference, block)
    loud = level > SILENT * level.max(initial=1e-30)
    near = np.convolve(loud, np.ones(round(TAIL_S * 10) + 2))[1 : 1 + loud.size] > 0
    return ~np.repeat(near, block)[: reference.size]


def fan_in_silences(recording: Samples, silent: NDArray[np.bool_]) -> tuple[Samples, float]:
    """Noise PSD (601,) float32 of the quieter half of the frames in which the robot is silent, and their seconds.

    silent: (n,), of each sample. With fewer than FIT.least_frames such frames: PSD of the quietest 5 % of all, and 0 seconds.
    """
    step = GRID_FFT // 2
    power = periodograms(recording, GRID_FFT)
    whole = frames(silent, GRID_FFT, step).all(axis=1)
    share = 0.5 if whole.sum() >= FIT.least_frames else 0.05
    at = np.flatnonzero(whole) if share == 0.5 else np.arange(power.shape[0])
    order = at[np.argsort([np.log(np.maximum(power[frame], ROUNDING_PSD)).mean() for frame in at])]
    kept = power[order[: max(int(share * order.size), FIT.least_frames // 2)]]
    psd = uniform_filter1d(kept.mean(axis=0), 5, mode="nearest")
    return psd.astype(np.float32), kept.shape[0] * step / SAMPLE_RATE if share == 0.5 else 0.0


def disturbance(residual: Samples) -> Samples:
    """Weights, 0 to 1, by which a fit trusts each sample, (n,): one over the power of the whitened residual (n,) around it."""
    return 1.0 / np.maximum(uniform_filter1d(residual**2, FIT.moment, mode="nearest"), 1.0)


def fit_path(sound: Samples, target: Samples, weights: Samples, peak: float) -> Samples:
    """Path from sound to target (n,), both whitened, (FIT.taps,). weights: (n,); peak: the square of the direct sound's tap.

    The penalty supposes a decay; the one of FIT.decays_s is kept whose fit to three quarters of the weighted samples
    predicts the rest best.
    """
    rest = np.arange(target.size) // (BLOCK // 4) % 4 == 3

    def left(prior: Array) -> float:
        taps = fit_filter(sound, target, weights * ~rest, FIT.taps, 0, prior)
        return float(np.sum(weights * rest * (target - filtered(sound, taps, 0)) ** 2))

    best = min((decay_prior(seconds, peak) for seconds in FIT.decays_s), key=left)
    taps = fit_filter(sound, target, weights, FIT.taps, 0, best, steps=12)
    weights = np.where(weights > 0.0, disturbance(target - filtered(sound, taps, 0)), 0.0).astype(np.float32)
    return fit_filter(sound, target, weights, FIT.taps, 0, best, steps=20)


def decay_prior(seconds: float, peak: float) -> Array:
    """Expected squares, (FIT.taps,): the direct sound's; from 2 ms on 15 dB less, falling by 60 dB in that time; before it 25 dB less."""
    at = np.arange(FIT.taps) - PRE_ROLL
    late = 10**-1.5 * 10 ** (-6 * np.maximum(at, 0) / (seconds * SAMPLE_RATE))
    return peak * np.where(at < -16, 10**-2.5, np.where(at < 32, 1.0, late))


def bands_over_fan(predicted: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Third-octave bands (B, 2) Hz and the mean power of the whitened prediction in each over the fan's, dB."""
    bands = third_octave_bands()
    density = periodograms(predicted, GRID_FFT).mean(axis=0) * SAMPLE_RATE / 2
    means = [density[(GRID_HZ >= low - 7) & (GRID_HZ < high + 7)].mean() for low, high in bands]
    return bands, 10 * np.log10(np.clip(np.array(means, np.float64), 1e-2, 1e12))


def _check_learned(target: Samples, predicted: Samples, fit: Samples, delay: float, ppm: float, missing: str) -> None:
    """Raise SignalError unless the prediction takes CLEARLY_DB away in a fifth of the blocks that no fit has used."""
    drop = decibels(block_power(target, BLOCK)) - decibels(block_power(target - predicted, BLOCK))
    held = drop[block_power(fit, BLOCK) == 0.0]
    if held.size and float(np.quantile(held, 0.8)) >= CLEARLY_DB:
        return
    clocks = f", clocks {abs(ppm):.0f} ppm apart" if ppm else ""
    raise SignalError(
        f"the robot is in the recording (lag {1000 * delay / SAMPLE_RATE:.0f} ms{clocks}) but too faint beside what"
        f" else is heard to learn its path from: {missing or 'does a human talk nearly all the time?'}; give a recording"
        " in which the robot talks alone, or a calibration (--profile)"
    )


def others(target: Samples, predicted: Samples) -> list[tuple[float, float]]:
    """Stretches (start_s, end_s) in which another source is louder than the robot; gaps of a second or less between them are filled.

    target, predicted: recording and prediction, whitened, (n,). There their difference is FIT.others_db above both the prediction and the fan.
    """
    rest = block_power(target - predicted, BLOCK)
    loud = rest > 10 ** (FIT.others_db / 10) * np.maximum(block_power(predicted, BLOCK), 10.0)
    loud = binary_closing(np.pad(loud, 2), np.ones(3))[2:-2]
    edges = np.flatnonzero(np.diff(np.concatenate(([False], loud, [False]))))
    return [(begin * BLOCK / SAMPLE_RATE, end * BLOCK / SAMPLE_RATE) for begin, end in edges.reshape(-1, 2)]


def _warnings(seconds: float, talk: list[tuple[float, float]]) -> list[str]:
    told = [
        "no calibration: path and fan are measured in this recording itself, so a gain, a band limit, a resonance, the"
        " room's reverberation and a changed fan cannot be told from it"
    ]
    if seconds == 0.0:
        told.append("the robot is hardly silent here: the quietest moments of the recording stand for the fan")
    elif seconds < 0.5:
        told.append(f"only {seconds:.1f} s in which the robot is silent: its fan is known only roughly")
    if talk:
        spans = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in talk)
        told.append(
            f"a human, or another source that is louder than the robot, is active at {spans}: the residual there is not"
            " the robot's echo"
        )
    return told
