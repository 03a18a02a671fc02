"""The fan does not sound as it did at the calibration: another speed, another spectrum."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.frames import decibels, frames
from edgefilter.dsp.psd import floored, periodograms
from edgefilter.dsp.tones import tones
from edgefilter.echo.effect import Effect, Parameter, first, neutral, within
from edgefilter.echo.least_squares import absorbed
from edgefilter.echo.measurement import SILENT, STEADY_DB, Measurement, Values, VoiceModel
from edgefilter.types import Array, Samples

FEWEST_FRAMES, QUIET_SHARE = 12, 0.25
"""Half-overlapping frames of silence; with fewer, that part of all frames, the quietest at each frequency, is taken."""
SMOOTH = np.array([0.25, 0.5, 0.25])
"""Over neighbouring bins of 13.3 Hz: a Hann frame's line is as wide."""


class FanNoise(Effect):
    """The fan's power spectrum is another by spectrum_db at each frequency; the voice itself is unchanged.

    spectrum_db: (601,) on the profile's grid, 0 to 8 kHz, or one number. change_db only reports: the change of the
    fan's total power.
    """

    name = "fan_noise"
    stage = "noise"
    family = "additive noise"
    title = "changed fan noise"
    memory = 0
    parameters = (
        Parameter("spectrum_db", "dB", 0.0, -60.0, 60.0),
        Parameter("change_db", "dB", 0.0, -60.0, 60.0),
    )

    def noise_psd(self, values: Values, psd: Samples) -> Samples:
        return (psd * 10.0 ** (np.asarray(values["spectrum_db"], float) / 10.0)).astype(np.float32)

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
        if silent.sum() >= FEWEST_FRAMES:
            found = residual[silent].mean(axis=0)
        else:
            found = _quiet_mean(residual[whole] if whole.any() else residual)
        if silent.any():
            heard, was, now = residual[silent], floored(known), floored(found)
            swing_db = np.ptp(decibels(np.quantile(np.mean(heard / now, axis=1), (0.1, 0.9))))
            if swing_db > STEADY_DB or np.mean(np.log(now / was) + heard / now - heard / was) > 0.0:
                return neutral(self)
        floor = floored(known if measurement.calibrated_psd is None else measurement.calibrated_psd)
        smooth = np.convolve(np.pad(found / floor, 1, mode="edge"), SMOOTH, "valid")
        total = 10.0 * np.log10(np.sum(smooth * floor) / np.sum(floor) + 1e-30)
        return within(self, {"spectrum_db": 10.0 * np.log10(smooth + 1e-30), "change_db": total})

    def sentence(self, values: Values) -> str:
        return (
            f"the noise is {first(values, 'change_db'):+.1f} dB off the calibrated fan, with the robot's voice and"
            " without it"
        )


def _quiet_mean(power: Array) -> Array:
    """Mean of exponentially distributed power (f, b) from the lowest QUIET_SHARE of its values at each frequency, (b,)."""
    kept = max(int(QUIET_SHARE * len(power)), 1)
    share = kept / len(power)
    bias = 1.0 + (1.0 - share) * np.log1p(-share) / share if share < 1.0 else 1.0
    return np.sort(power, axis=0)[:kept].mean(axis=0) / bias
