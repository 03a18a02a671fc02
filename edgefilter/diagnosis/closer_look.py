"""A closer look at what no effect explains: the law of each family, as fitted to what is left, and the robot's silences."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.straightened import bands
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.dsp.frames import decibels, frames
from edgefilter.dsp.psd import GRID_FFT, frequencies, periodograms
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.free_laws import FreeLaw
from edgefilter.types import Array

SILENCES = "frequency, in the robot's silences"


@dataclass(frozen=True)
class Curve:
    """A law, or the silences, drawn: x and y (k,), a gain unless y_unit says otherwise; share: part of what is left that it explains."""

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

    @classmethod
    def of_law(cls, law: Trial) -> Curve:
        """Of a free law; share: of the level over the silences that is left without it."""
        effect = find(law.name)
        assert isinstance(effect, FreeLaw)
        name, unit, x, y, y_unit = effect.drawn(law.values)
        left = law.gain_db + law.score.over_db - law.score.floor_db
        return cls.of(name, unit, x, y, law.gain_db / max(left, 1e-9), y_unit)

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        rounded = {"x": np.round(self.x, 3).tolist(), "y_db": np.round(self.y_db, 2).tolist()}
        return {**asdict(self), **rounded, "share": round(self.share, 4)}


@dataclass(frozen=True)
class CloserLook:
    """The curves, that of the law that explains most first, and one sentence on what to look at."""

    curves: tuple[Curve, ...] = ()
    sentence: str = ""

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {"sentence": self.sentence, "curves": [curve.to_dict() for curve in self.curves]}


def look_closer(found: Found) -> CloserLook:
    """What the final residual of a search looks like to each law that was tried beside all that was found."""
    laws = sorted((law for law in found.laws if law.gain_db > 0.0), key=lambda law: -law.gain_db)
    curves, silences = [Curve.of_law(law) for law in laws], _silences(found)
    shown = (*curves, *((silences,) if silences else ()))
    if curves and curves[0].share >= Criteria.nothing:
        effect, share = find(laws[0].name), 100 * curves[0].share
        return CloserLook(shown, f"{effect.title} would explain {share:.0f} % of it: {effect.sentence(laws[0].values)}")
    if silences and max(map(abs, silences.y_db)) > 3.0:
        at = int(np.argmax(np.abs(silences.y_db)))
        off = f"{silences.y_db[at]:+.1f} dB off the calibrated fan around {silences.x[at]:.0f} Hz"
        return CloserLook(shown, f"look at the robot's silences: they are {off}")
    return CloserLook(
        shown, "no law of any family explains it: what is left does not follow the voice's wave; listen to it"
    )


def _silences(found: Found) -> Curve | None:
    """The spectrum of what is left while the robot is silent, over the fan's; None where that is too seldom."""
    recording = found.in_noise
    silent = frames(recording.usable & ~recording.active, GRID_FFT, GRID_FFT // 2).all(axis=1)
    if silent.sum() < 10:
        return None
    left = recording.measurement.recording - found.final.prediction
    ratio = periodograms(left, GRID_FFT)[silent].mean(axis=0) / recording.noise_psd
    low, high = bands().hz.T
    place = np.digitize(frequencies(ratio.size), (*low, high[-1]))
    y = [float(decibels(ratio[place == k].mean())) for k in range(1, low.size + 1)]
    return Curve.of(SILENCES, "Hz", np.sqrt(low * high), np.array(y), 0.0)
