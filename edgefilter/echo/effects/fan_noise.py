"""The fan does not sound as it did at the calibration: another speed, another spectrum."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.frames import decibels, frames
from edgefilter.dsp.psd import GRID_BINS, floored, periodograms
from edgefilter.dsp.tones import tones
from edgefilter.echo.effect import NEVER_S, RECORDING, Effect, Parameter, first, neutral, numbers, within
from edgefilter.echo.least_squares import absorbed
from edgefilter.echo.measurement import SILENT, STEADY_DB, Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

FEWEST_FRAMES, QUIET_SHARE = 12, 0.25
"""Half-overlapping frames of silence; with fewer, that part of all frames, the quietest at each frequency, is taken."""
SMOOTH = np.array([0.25, 0.5, 0.25])
"""Over neighbouring bins of 13.3 Hz: a Hann frame's line is as wide."""


class FanNoise(Effect):
    """S(f) = 10^(spectrum_db(f) / 10) S0(f), S0 the calibrated power spectral density of the fan; the voice is unchanged.

    spectrum_db: (601,) on the profile's grid, 0 to 8 kHz, or one number. change_db: change of the fan's total
    power, for reports only. from_s: when the change begins in the recording that was fitted to; in others it holds throughout.
    """

    name = "fan_noise"
    stage = "noise"
    family = "additive noise"
    title = "changed fan noise"
    memory = 0
    parameters = (
        Parameter("spectrum_db", "dB", 0.0, -60.0, 60.0),
        Parameter("change_db", "dB", 0.0, -60.0, 60.0),
        Parameter("from_s", "s", 0.0, 0.0, NEVER_S),
        RECORDING,
    )

    def noise_psd(self, values: Values, psd: Samples) -> Samples:
        return (psd * 10.0 ** (np.asarray(values["spectrum_db"], float) / 10.0)).astype(np.float32)

    def passed(self, noise: Samples, voice: Samples, values: Values, sample_rate: int) -> Samples:
        start = round(first(values, "from_s") * sample_rate)
        if start == 0:
            return noise
        taps = np.fft.irfft(10.0 ** (-numbers(values, "spectrum_db", GRID_BINS) / 20.0))
        before = filtered(noise[:start], np.roll(taps, GRID_BINS - 1), GRID_BINS - 1)
        return np.concatenate((before, noise[start:]))

    def elsewhere(self, values: Values) -> Values:
        return {**values, "from_s": 0.0} if first(values, "from_s") else values

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Mean periodogram of the residual in the robot's silences over the calibrated PSD.

        Where the robot is hardly ever silent, the mean of the quietest quarter of all frames at each frequency, divided
        by what that share of an exponential distribution has as its mean (the idea of Martin 2001, "minimum
        statistics", without its tracking). Neutral where the silences are not as likely so, swing or hum.
        """
        known = measurement.noise_psd
        if known is None:
            return neutral(self)
        voice = absorbed(measurement.predicted(model)[0], measurement.recording, measurement.fit)
        size = 2 * (known.size - 1)
        left = measurement.recording - voice
        residual = periodograms(left, size)
        if not len(residual) or tones(left, known)[1]:
            return neutral(self)
        whole = frames(measurement.weights, size, size // 2).all(axis=1)
        own = np.mean(frames(measurement.whiten(voice), size, size // 2) ** 2, axis=1)
        silent = whole & (own < SILENT)
        heard, was, start = residual[silent], floored(known), 0
        quiet = residual[whole] if whole.any() else residual
        found = heard.mean(axis=0) if len(heard) >= FEWEST_FRAMES else _quiet_mean(quiet)
        if len(heard):
            if _swings(heard, found):
                start = _turn(heard, was)
                if not start or abs(np.median(_levels_db(heard[:start], was))) > STEADY_DB:
                    return neutral(self)
                heard, found = heard[start:], heard[start:].mean(axis=0)
            now = floored(found)
            if _swings(heard, found) or np.mean(np.log(now / was) + heard / now - heard / was) > 0.0:
                return neutral(self)
        from_s = float(np.flatnonzero(silent)[start] * size / 2 / SAMPLE_RATE) if start else 0.0
        floor = floored(known if measurement.calibrated_psd is None else measurement.calibrated_psd)
        smooth = np.convolve(np.pad(found / floor, 1, mode="edge"), SMOOTH, "valid")
        total = 10.0 * np.log10(np.sum(smooth * floor) / np.sum(floor) + 1e-30)
        return within(self, {"spectrum_db": 10.0 * np.log10(smooth + 1e-30), "change_db": total, "from_s": from_s})

    def sentence(self, values: Values) -> str:
        from_s = first(values, "from_s")
        since = f" from {from_s:.1f} s on" if from_s else ""
        return (
            f"the noise is {first(values, 'change_db'):+.1f} dB off the calibrated fan{since}, with the robot's voice and"
            " without it"
        )


def _swings(heard: Array, expected: Array) -> bool:
    """Whether the levels of periodograms (f, b), over a density (b,), differ among each other by more than STEADY_DB; one answer for all."""
    return bool(np.ptp(np.quantile(_levels_db(heard, expected), (0.1, 0.9))) > STEADY_DB)


def _levels_db(heard: Array, expected: Array) -> Array:
    """Of each of periodograms (f, b) the mean over a density (b,), dB, (f,)."""
    return np.asarray(decibels(np.mean(heard / floored(expected), axis=1)))


def _turn(heard: Samples, was: Array) -> int:
    """The likeliest index, of periodograms (f, b), from which they lie around another density than was (b,); 0 where they are too few."""
    rest = np.arange(len(heard), 0, -1)
    after = np.cumsum(heard[::-1], axis=0)[::-1] / rest[:, None]
    before = np.cumsum(np.sum(np.log(was) + heard / was, axis=1))[:-1]
    cost = before + rest[1:] * np.sum(np.log(floored(after[1:].astype(np.float32))) + 1.0, axis=1)
    possible = cost[FEWEST_FRAMES - 1 : 1 - FEWEST_FRAMES]
    return FEWEST_FRAMES + int(np.argmin(possible)) if possible.size else 0


def _quiet_mean(power: Array) -> Array:
    """Mean of exponentially distributed power (f, b) from the lowest QUIET_SHARE of its values at each frequency, (b,)."""
    kept = max(int(QUIET_SHARE * len(power)), 1)
    share = kept / len(power)
    bias = 1.0 + (1.0 - share) * np.log1p(-share) / share if share < 1.0 else 1.0
    return np.sort(power, axis=0)[:kept].mean(axis=0) / bias
