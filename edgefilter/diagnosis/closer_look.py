"""A closer look at what no effect explains: the gain that is missing by time, rate, level and frequency, and silences."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.trials import Found
from edgefilter.dsp.frames import block_power, block_sums, decibels, frames
from edgefilter.dsp.psd import GRID_FFT, frequencies, periodograms
from edgefilter.echo.effects.free_laws import STEP as BEAT_STEP
from edgefilter.echo.effects.free_laws import by_rate
from edgefilter.echo.effects.mic_agc import SURE
from edgefilter.echo.wiener import spectra
from edgefilter.types import SAMPLE_RATE, Array, Samples

STEP = SAMPLE_RATE // 50
"""Samples (20 ms) over which energies are summed, of whose ratio a gain is taken."""
TIME_S, LEVEL_DB, RATES_HZ = 0.04, 5.0, (1.0, 30.0)
"""Of one point of a curve: five in a period of a tremolo of 5 Hz; and the rates that are looked at."""
BANDS_HZ = np.geomspace(100.0, 7800.0, 20)
RATE, SILENCES = "rate at which the gain comes and goes", "frequency, in the robot's silences"


@dataclass(frozen=True)
class Curve:
    """One look: x and y (k,), a gain unless y_unit says otherwise.

    share: part of what is left while the robot talks that a change of that kind would explain.
    """

    name: str
    x_unit: str
    x: tuple[float, ...]
    y_db: tuple[float, ...]
    share: float
    y_unit: str = "dB"

    @classmethod
    def of(cls, name: str, x_unit: str, x: Array, y_db: Array, share: float, y_unit: str = "dB") -> Curve:
        """From arrays (k,); the share is held between 0 and 1."""
        return cls(name, x_unit, tuple(map(float, x)), tuple(map(float, y_db)), float(np.clip(share, 0.0, 1.0)), y_unit)

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        rounded = {"x": np.round(self.x, 3).tolist(), "y_db": np.round(self.y_db, 2).tolist()}
        return {**asdict(self), **rounded, "share": round(self.share, 4)}


@dataclass(frozen=True)
class CloserLook:
    """The curves, those of few numbers first, and one sentence on which of them to look at."""

    curves: tuple[Curve, ...] = ()
    sentence: str = ""

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {"sentence": self.sentence, "curves": [curve.to_dict() for curve in self.curves]}


def look_closer(found: Found) -> CloserLook:
    """What the final residual of a search looks like beside the prediction."""
    prepared = found.in_noise
    predicted = prepared.measurement.whiten(found.final.prediction)
    voice = predicted * prepared.usable
    left = (prepared.measurement.white_recording - predicted) * prepared.usable
    gains = _Gains(voice, left)
    level = decibels(block_power(found.final.prediction, STEP))
    time = np.arange(level.size) * STEP / SAMPLE_RATE
    curves = [
        _over_rate(voice, left, gains),
        gains.over("level of the robot's voice", "dBFS", np.floor(level / LEVEL_DB), LEVEL_DB),
        _over_frequency(prepared, voice, left, gains),
        gains.over("time", "s", np.floor(time / TIME_S), TIME_S),
        _silence(prepared, found.final.prediction),
    ]
    shown = tuple(curve for curve in curves if len(curve.x) > 1)
    return CloserLook(shown, _told(shown))


class _Gains:
    """Least-squares gains of a voice (n,) in what is left of the recording (n,), both whitened, by groups of steps."""

    def __init__(self, voice: Samples, left: Samples) -> None:
        self.energy, self.cross = (block_sums(voice * other, STEP) for other in (voice, voice + left))
        self.whole = float(np.sum(block_sums(left * left, STEP)[self.energy > SURE]))
        self.noise = max(self.whole / max(STEP * np.count_nonzero(self.energy > SURE), 1), 1.0)

    def over(self, name: str, unit: str, group: Array, width: float) -> Curve:
        """The gain of each group (steps,), at the group's middle, and the share that all explain beyond chance."""
        keys, place = np.unique(group[: self.energy.size], return_inverse=True)
        energy, cross = (np.bincount(place, part) for part in (self.energy, self.cross))
        sure = energy > SURE
        if sure.sum() < 2:
            return Curve(name, unit, (), (), 0.0)
        gain = cross[sure] / energy[sure]
        away = float(np.sum(energy[sure] * (gain - 1.0) ** 2)) - sure.sum() * self.noise
        return Curve.of(name, unit, (keys[sure] + 0.5) * width, _gain_db(gain), away / max(self.whole, 1e-9))


def _over_rate(voice: Samples, left: Samples, gains: _Gains) -> Curve:
    energy, cross = (block_sums(voice * other, BEAT_STEP) for other in (voice, voice + left))
    if not energy.any():
        return Curve(RATE, "Hz", (), (), 0.0)
    rates, worth, depth = by_rate(energy, cross, *RATES_HZ)
    away = float(worth.max() - np.median(worth))
    place = np.digitize(rates, np.geomspace(RATES_HZ[0], rates[-1], 61))
    deepest = np.array([np.argmax(np.where(place == k, depth, -1.0)) for k in np.unique(place)])
    return Curve.of(RATE, "Hz", rates[deepest], 20.0 * np.log10(1.0 + depth[deepest]), away / max(gains.whole, 1e-9))


def _over_frequency(prepared: Prepared, voice: Samples, left: Samples, gains: _Gains) -> Curve:
    found = spectra(prepared.measurement, voice, 20.0)
    place = np.digitize(found.hz, BANDS_HZ)
    inside = (place > 0) & (place < BANDS_HZ.size)
    power, cross = (
        np.bincount(place[inside], part[inside], BANDS_HZ.size)[1:] for part in (found.predicted, found.cross.real)
    )
    sure = power > SURE
    gain = cross[sure] / power[sure]
    away = float(np.sum(power[sure] * (gain - 1.0) ** 2)) / max(float(np.sum(found.predicted)), 1e-9)
    share = away * float(np.sum(gains.energy)) / max(gains.whole, 1e-9)
    return Curve.of("frequency", "Hz", _middles_hz()[sure], _gain_db(gain), share)


def _silence(prepared: Prepared, prediction: Samples) -> Curve:
    """The spectrum of what is left while the robot is silent, over the fan's; its share is of no gain."""
    left, quiet = prepared.measurement.recording - prediction, prepared.usable & ~prepared.active
    silent = frames(quiet, GRID_FFT, GRID_FFT // 2).all(axis=1)
    if silent.sum() < 10:
        return Curve(SILENCES, "Hz", (), (), 0.0)
    ratio = periodograms(left, GRID_FFT)[silent].mean(axis=0) / prepared.noise_psd
    place = np.digitize(frequencies(ratio.size), BANDS_HZ)
    y = [float(decibels(ratio[place == k].mean())) for k in range(1, BANDS_HZ.size)]
    return Curve.of(SILENCES, "Hz", _middles_hz(), np.array(y), 0.0)


def _middles_hz() -> Array:
    """Centre frequency of each band between BANDS_HZ, geometric, Hz."""
    return np.sqrt(BANDS_HZ[1:] * BANDS_HZ[:-1])


def _gain_db(gain: Array) -> Array:
    """Decibels of a gain, at most 30 either way."""
    return 20.0 * np.log10(np.clip(gain, 0.03, 30.0))


def _told(curves: tuple[Curve, ...]) -> str:
    """Which curve to look at: of those that would explain half of what any would the one of fewest numbers, or silences.

    A gain that explains next to nothing (Criteria.nothing) is not pointed at: any model errs by so much.
    """
    most_share = max((curve.share for curve in curves), default=0.0)
    if most_share >= Criteria.nothing:
        telling = next(curve for curve in curves if curve.share >= 0.5 * most_share)
        worth = f"would explain {100 * telling.share:.0f} % of what is left"
        most, least = int(np.argmax(telling.y_db)), int(np.argmin(telling.y_db))
        if telling.name == RATE:
            return (
                f"look at the gain over time: it comes and goes {telling.x[most]:.3g} times a second, and that {worth}"
            )
        high, low = (f"{telling.y_db[i]:+.1f} dB at {telling.x[i]:.3g} {telling.x_unit}" for i in (most, least))
        return f"look at the gain by {telling.name}: highest, {high}, and lowest, {low}, it {worth}"
    silence = next((curve for curve in curves if curve.name == SILENCES), None)
    if silence is not None and max(map(abs, silence.y_db)) > 3.0:
        at = int(np.argmax(np.abs(silence.y_db)))
        off = f"{silence.y_db[at]:+.1f} dB off the calibrated fan around {silence.x[at]:.0f} Hz"
        return f"look at the robot's silences: they are {off}"
    return "no gain of the predicted voice explains it: what is left does not follow the voice's wave; listen to it"
