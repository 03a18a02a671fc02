"""How well a prediction explains a recording on the samples that no fit has used."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d

from edgefilter.diagnosis.prepare import FRAME, HOP, Prepared
from edgefilter.dsp import fourier
from edgefilter.dsp.frames import decibels, frames
from edgefilter.dsp.psd import GRID_BINS, ROUNDING_PSD, coloured, frequencies, hann, variance_at
from edgefilter.echo.evidence import Score
from edgefilter.echo.least_squares import normal_equations
from edgefilter.echo.model import EchoModel
from edgefilter.echo.recording import BLOCK
from edgefilter.echo.wiener import convolve_from
from edgefilter.types import Array, Samples

FRAMES_PER_CELL = 8
STEP = HOP * FRAMES_PER_CELL
"""Samples from one cell to the next."""
SPAN = STEP - HOP + FRAME
"""Samples of one cell."""
FEWEST = round(BLOCK / STEP)
"""Cells, half a second of them, that tell of what the robot's silences are."""
TOLERANCE = 0.012
"""An ordinary robot's path differs from its calibration by this share at each frequency (0.1 dB, 0.7 degrees)."""
TOLERANCE_TAPS = 32
"""Of the filter, 2 ms, its middle at 0, that takes up so much."""


class Scorer:
    """Scores predictions of a prepared recording.

    In the cells of time and frequency that no fit has seen the residual is held to be Gaussian (Whittle 1953), with the
    variance that the model expects times an unknown factor, since every model errs: Student's t. So what counts is that
    the residual sinks in many cells, not that one loud passage does.
    """

    def __init__(self, prepared: Prepared) -> None:
        self.prepared, self.measurement, self.usable = prepared, prepared.measurement, prepared.usable
        self.psd = prepared.noise_psd
        n = self.usable.size
        self._window = hann(FRAME).astype(np.float32)
        hz = frequencies(FRAME // 2 + 1)
        self._expected = variance_at(hz, self.psd) * float(np.sum(self._window**2))
        self._rows = prepared.fit & prepared.usable & prepared.active & (np.arange(n) % 3 == 0)
        starts = np.arange(0, n - SPAN + 1, STEP)
        held = np.concatenate(([0], np.cumsum(prepared.held_out)))
        heard = np.concatenate(([0], np.cumsum(prepared.active)))
        self.starts = starts[held[starts + SPAN] - held[starts] >= 0.9 * SPAN]
        self.active_cells = (heard[self.starts + SPAN] - heard[self.starts]) > 0.3 * SPAN
        silent = ~self.active_cells
        self.silent_cells = silent & (np.count_nonzero(silent) >= FEWEST)
        edges = np.unique(np.concatenate(([2], np.round(np.geomspace(4, FRAME // 2 - 6, 26)).astype(int))))
        self._edges = edges
        self.band_hz = np.stack((hz[edges[:-1]], hz[edges[1:]]), axis=1)
        self.freedom = np.diff(edges).astype(float)
        self._others: dict[bytes, Scorer] = {}

    @cached_property
    def _fan(self) -> Samples:
        """A sound like the fan, (n,)."""
        return coloured(np.random.default_rng(0), self.usable.size, self.psd).astype(np.float32)

    @cached_property
    def _rounding(self) -> Samples:
        """What the rounding to 16 bit leaves where nothing else is heard, (n,)."""
        return coloured(np.random.default_rng(1), self.usable.size, np.full(GRID_BINS, ROUNDING_PSD)).astype(np.float32)

    @cached_property
    def _fan_cells(self) -> Array:
        """Power of that in the held-out cells, (times, bands)."""
        return self.cells(self._fan)

    @cached_property
    def _ordinary_cells(self) -> Array:
        """What is expected over the fan where nothing is missing, (times, bands)."""
        return self._expected_cells(self.prepared.ordinary)

    def over_db(self, prediction: Samples, noise: Array) -> float:
        """Score.over_db of a prediction (n,), with noise (times, bands) over the fan's expected in the cells."""
        residual = self.measurement.recording - self.correct(prediction, self.measurement.whiten(prediction))
        return self._mean(decibels(0.5 + 0.5 * self.cells(residual) / noise))

    def cells(self, residual: Samples) -> Array:
        """Power of the residual (n,) over the fan's, in the held-out cells, (times, bands)."""
        at = self.starts[:, None] + np.arange(FRAMES_PER_CELL) * HOP
        read = frames(residual, FRAME, 1)[at] * self._window
        return self._by_band(fourier.power(fft.rfft(read, axis=-1)).mean(axis=1) / self._expected)

    def behind(self, model: EchoModel) -> Scorer:
        """The scorer with the fan that a model expects; itself where that is the profile's."""
        prepared = self.prepared.behind(model)
        if prepared is self.prepared:
            return self
        key = prepared.noise_psd.tobytes()
        if key not in self._others:
            self._others[key] = Scorer(prepared)
        return self._others[key]

    def of(self, model: EchoModel, prediction: Samples | None = None) -> Score:
        """The score of a model: of what it predicts, or of another prediction (n,), in the noise that it expects.

        That is the fan, as what is at the microphone lets it through, and what no waveform predicts. The ordinary
        tolerances are taken up first.
        """
        here, reference = self.behind(model), self.measurement.reference
        heard = (
            here.measurement.predicted(model)
            if prediction is None
            else (prediction, here.measurement.whiten(prediction))
        )
        passed, gain = model.passed(here._fan, reference), model.microphone_gain(self.usable.size)
        return here._score(*heard, model.unpredictable(reference), passed, gain, self)

    def _score(
        self,
        prediction: Samples,
        white: Samples,
        unpredictable: Sequence[tuple[Samples, Array]],
        passed: Samples,
        gain: Samples,
        known: Scorer,
    ) -> Score:
        """The score of a prediction (n,), also given whitened, in what passed (n,) of this fan; known: of the profile's.

        gain: (n,) of the microphone, which the fan passed as well: it is taken out of the residual before that is held
        against the fan. The cells keep it: as a likelihood their level has to be that of the recording as it is.
        """
        corrected = self.correct(prediction, white)
        residual = self.measurement.recording - corrected
        expected = (*unpredictable, *self.prepared.ordinary)
        variance = self._expected_cells(expected)
        plain = self.measurement.whiten(residual / gain).astype(np.float64) ** 2
        power = self._over_expected(plain, expected) if expected else plain
        if passed is not self._fan:
            variance = variance * (self.cells(passed + self._rounding) / self._fan_cells)
        cells = self.cells(residual) / variance
        levels = decibels(0.5 + 0.5 * cells)
        over_db = self._mean(levels)
        louder = self._by_band(self._expected / known._expected)
        cost_db = self._mean(0.5 * decibels(variance * louder / known._ordinary_cells))
        held, active = self.prepared.held_out, self.prepared.active
        return Score(
            level_db=over_db + cost_db,
            over_db=over_db,
            floor_db=self._mean(levels[self.silent_cells]),
            excess_db=_db(power[held]),
            active_db=_db(power[held & active]),
            silent_db=_db(power[held & ~active]),
            fitted_db=_db(power[self.prepared.fit & active]),
            irreducible_db=_db(plain[held]) if unpredictable else 0.0,
            cells=cells,
            prediction=corrected,
        )

    def silent_db(self, score: Score) -> float:
        """By how much the robot's silences, or all where it is never silent, are louder than expected, dB."""
        power = self._mean(score.cells[self.silent_cells] if self.silent_cells.any() else score.cells)
        return float(decibels(power)) if power > 0.0 else 0.0

    def correct(self, prediction: Samples, white: Samples) -> Samples:
        """A prediction, also given whitened, through the filter, within TOLERANCE of 1, that brings it closest to the recording."""
        target, lead = self.measurement.white_recording - white, TOLERANCE_TAPS // 2
        weights, _ = normal_equations([white], target, TOLERANCE_TAPS, lead, self._rows).solve(1e-5)
        response = np.fft.rfft(weights[0], 256)
        bounded = np.fft.irfft(response * np.minimum(1.0, TOLERANCE / np.maximum(np.abs(response), 1e-12)), 256)
        return prediction + convolve_from(prediction, np.roll(bounded, 96), 96 + lead)

    def _mean(self, cells: Array) -> float:
        """Mean over cells (times, bands), each by its degrees of freedom; 0 where there is none."""
        return float(np.average(cells.mean(axis=0), weights=self.freedom)) if cells.size else 0.0

    def _by_band(self, spectra: Array) -> Array:
        """Means of spectra (..., FRAME / 2 + 1) over the bins of each band, (..., bands)."""
        return np.add.reduceat(spectra[..., : self._edges[-1]], self._edges[:-1], axis=-1) / self.freedom

    def _expected_cells(self, unpredictable: Sequence[tuple[Samples, Array]]) -> Array:
        """What is expected in the held-out cells, 1 where that is the fan alone, (times, bands)."""
        expected = np.ones((self.starts.size, self.freedom.size))
        for variance, colour in unpredictable:
            total = np.concatenate(([0.0], np.cumsum(variance, dtype=np.float64)))
            mean = (total[self.starts + SPAN] - total[self.starts]) / SPAN
            bins = np.arange(FRAME // 2 + 1) * (colour.size - 1) / (FRAME // 2)
            share = np.interp(bins, np.arange(colour.size), colour / self.psd)
            expected = expected + mean[:, None] * self._by_band(share)
        return expected

    def _over_expected(self, power: Array, unpredictable: Sequence[tuple[Samples, Array]]) -> Array:
        """Power of the whitened residual over what is expected, (n,), smoothed over 16 ms: a knock is known to some ms."""
        expected = np.ones_like(power)
        for variance, colour in unpredictable:
            expected += variance * float(np.mean(colour / self.psd))
        return uniform_filter1d(power, HOP) / uniform_filter1d(expected, HOP)


def share_of(before_db: float, after_db: float) -> float:
    """Part of the power over the fan that is gone."""
    before, after = 10 ** (before_db / 10) - 1.0, 10 ** (after_db / 10) - 1.0
    return float(np.clip(1.0 - after / before, 0.0, 1.0)) if before > 0.0 else 0.0


def _db(power: Array) -> float:
    return float(decibels(np.mean(power))) if power.size else 0.0
