"""What speaks for an effect: how well a recording is explained before and after it, and the cells in which that is scored."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edgefilter.dsp.frames import decibels
from edgefilter.echo.measurement import Measurement, Values, VoiceModel, level_ratio
from edgefilter.types import Array, Samples


@dataclass(frozen=True, eq=False)
class Score:
    """Of one prediction.

    level_db: negative log likelihood of the residual's cells of time and frequency, in dB for each degree of freedom:
    Student's t of as many degrees as a cell has (Lange, Little & Taylor 1989, "Robust statistical modeling using the t
    distribution"), around the noise that the model expects. Far over that it is the mean of the cells' dB: many cells
    count, not the loudest. Noise that a model expects on top of the ordinary costs half of its dB: else anything could
    be called noise. over_db: the same without that cost. floor_db: that of the cells in which the robot is silent, 0 where it
    never is: what is left at best.
    excess_db: mean power of the held-out whitened residual, dB. active_db, silent_db: while the robot is heard, and is
    not. fitted_db: of the samples to fit on, while it is heard. Noise that a model expects counts as fan in these;
    irreducible_db: the excess over the fan alone then, else 0.
    cells: (times, bands) power over the fan. prediction: (n,) with the ordinary tolerances taken up.
    """

    level_db: float
    over_db: float
    floor_db: float
    excess_db: float
    active_db: float
    silent_db: float
    fitted_db: float
    irreducible_db: float
    cells: Array = field(repr=False)
    prediction: Samples = field(repr=False)


class Grid(Protocol):
    """The recording in cells of time and frequency, held-out ones alone, as the scorer of a diagnosis cuts it.

    starts: (times,) first sample of each. active_cells: (times,) bool, where the robot is heard. band_hz: (bands, 2)
    edges. freedom: (bands,) degrees of freedom of a cell.
    """

    starts: NDArray[np.signedinteger]
    active_cells: NDArray[np.bool_]
    band_hz: Array
    freedom: Array

    @property
    def measurement(self) -> Measurement:
        """The recording beside its reference."""

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Samples where nobody else talks, (n,)."""

    def cells(self, residual: Samples) -> Array:
        """Power of a signal (n,) over the fan's, (times, bands)."""

    def over_db(self, prediction: Samples, noise: Array) -> float:
        """Score.over_db of another prediction (n,), with noise (times, bands) over the fan's expected in the cells."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """One effect added to a model of a recording: its values, the model without it, the scores before and after."""

    values: Values
    model: VoiceModel
    grid: Grid
    before: Score
    after: Score

    @cached_property
    def noise(self) -> Array:
        """What the model without the effect expects besides a voice in each cell, over the fan's power, (times, bands)."""
        return self.grid.cells(self.grid.measurement.recording - self.before.prediction) / self.before.cells

    @cached_property
    def _silences(self) -> Array:
        """Power over what is expected with the effect in the moments in which the robot is silent, (times,)."""
        return np.average(self.after.cells[~self.grid.active_cells], axis=1, weights=self.grid.freedom)

    @property
    def silent_db(self) -> float:
        """Level of the robot's silences over what is expected with the effect, 0 where it is never silent."""
        return float(decibels(self._silences.mean())) if self._silences.size else 0.0

    @property
    def silent_gain_db(self) -> float:
        """By how much the effect lowers Score.level_db of the robot's silences alone; nan where it is never silent."""
        if not self._silences.size:
            return float("nan")
        silent, freedom = ~self.grid.active_cells, self.grid.freedom
        fall = self._level(self.before) - self._level(self.after)
        return float(np.average(fall[silent].mean(axis=0), weights=freedom))

    def _level(self, score: Score) -> Array:
        """Score.level_db of each cell, (times, bands)."""
        power = self.grid.cells(self.grid.measurement.recording - score.prediction)
        return decibels(0.5 + 0.5 * score.cells) + 0.5 * decibels(power / score.cells)

    @property
    def swing_db(self) -> float:
        """By how much the loud and the quiet tenth of the silences differ, 0 where they are too few."""
        return float(np.ptp(decibels(np.quantile(self._silences, (0.1, 0.9))))) if self._silences.size else 0.0

    def share(self, prediction: Samples) -> float:
        """Which part of what the effect explains another prediction (n,), a gain apart, does: that of its law without free taps, say."""
        measurement, fall = self.grid.measurement, self.before.over_db - self.after.over_db
        gain = level_ratio(measurement.white_recording, measurement.whiten(prediction) * measurement.weights)
        by_itself = self.before.over_db - self.grid.over_db(np.float32(gain) * prediction, self.noise)
        return by_itself / fall if fall > 0.0 else 0.0
