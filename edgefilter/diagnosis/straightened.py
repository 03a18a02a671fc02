"""A recording of the robot alone, straightened, and how well a model explains it on the samples that no fit has used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import uniform_filter1d

from edgefilter.dsp import fourier
from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.fractional_delay import interpolate
from edgefilter.dsp.frames import block_sums, decibels, frames
from edgefilter.dsp.psd import GRID_BINS, ROUNDING_PSD, coloured, floored, frequencies, hann, variance_at
from edgefilter.dsp.stft import StftConfig
from edgefilter.echo.effect import STAGES
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.least_squares import fitted_taps
from edgefilter.echo.measurement import Measurement, level_ratio
from edgefilter.echo.model import EchoModel
from edgefilter.echo.recording import BLOCK
from edgefilter.types import Array, Samples

FRAME, HOP = StftConfig.n_fft, StftConfig.hop
"""Samples of the frames that a prediction is judged in, those of the running filter."""
FRAMES_PER_CELL = 8
STEP = HOP * FRAMES_PER_CELL
"""Samples from one cell to the next."""
SPAN = STEP - HOP + FRAME
"""Samples of one cell."""
FEWEST = round(BLOCK / STEP)
"""Least number of cells without the robot, half a second, from which the level of its silences is read."""
TOLERANCE = 0.012
"""An ordinary robot's path differs from its calibration by this share at each frequency (0.1 dB, 0.7 degrees)."""
TOLERANCE_TAPS = 32
"""Of the filter, 2 ms, its middle at 0, that takes up so much."""


@dataclass(frozen=True, eq=False)
class Score:
    """Score of one prediction.

    level_db: negative log likelihood of the residual's time-frequency cells, in dB for each degree of freedom:
    Student's t of as many degrees as a cell has (Lange, Little & Taylor 1989, "Robust statistical modeling using the t
    distribution"), around the noise that the model expects. For a residual far above that noise it is the mean of the cells' dB, so many
    cells count, not the loudest. Noise that a model expects beside the fan costs half of its dB, since otherwise anything could be called
    noise. over_db: the same without that cost. floor_db: the same of the cells in which the robot is silent, 0 where it never is: the
    best that can be reached.
    excess_db: mean power of the held-out whitened residual, dB; active_db, silent_db: the same while the robot is heard, and while it
    is not. In these three, noise that the model expects counts as fan; irreducible_db: the excess over the fan alone where it expects
    such noise, else 0. cells: (times, bands) power over the fan. prediction: (n,), with the ordinary tolerances fitted.
    """

    level_db: float
    over_db: float
    floor_db: float
    excess_db: float
    active_db: float
    silent_db: float
    irreducible_db: float
    cells: Array = field(repr=False)
    prediction: Samples = field(repr=False)


class Bands(NamedTuple):
    """Of a cell: bins at which bands begin, (bands + 1,), their edges in Hz, (bands, 2), their degrees of freedom, (bands,)."""

    bins: NDArray[np.integer]
    hz: Array
    freedom: Array


@cache
def bands() -> Bands:
    """The bands in which residuals are judged, a third of an octave and less each."""
    bins = np.unique(np.concatenate(([2], np.round(np.geomspace(4, FRAME // 2 - 6, 26)).astype(int))))
    hz = frequencies(FRAME // 2 + 1)[bins]
    return Bands(bins, np.stack((hz[:-1], hz[1:]), axis=1), np.diff(bins).astype(float))


@dataclass(frozen=True, eq=False)
class Straightened:
    """A recording beside what the profile predicts, on one sample counter; all arrays (n,).

    measurement: aligned reference, recording, the fan's PSD, the samples to fit on. model: the profile's, less the
    events of other recordings. prediction: of that model. usable: samples where nobody else talks. active: where the
    robot is heard. offset: samples of lag against the calibration. human: (start_s, end_s) of other talkers. ordinary:
    the robot's own distortion, as calibrated, in the form of EchoModel.unpredictable.

    of() scores models. In the cells of time and frequency that no fit has seen the residual is held to be Gaussian
    (Whittle 1953), with the variance that the model expects times an unknown factor, since every model errs: Student's t.
    So what counts is that the residual sinks in many cells, not that one loud passage does.
    """

    measurement: Measurement
    model: EchoModel
    prediction: Samples
    usable: NDArray[np.bool_]
    active: NDArray[np.bool_]
    offset: float
    human: tuple[tuple[float, float], ...] = ()
    warnings: tuple[str, ...] = ()
    ordinary: tuple[tuple[Samples, Array], ...] = ()
    _behind: dict[bytes, Straightened] = field(default_factory=dict, init=False, repr=False)
    _unmoved: dict[bytes, Measurement] = field(default_factory=dict, init=False, repr=False)

    @property
    def held_out(self) -> NDArray[np.bool_]:
        """Samples that no fit has used, (n,)."""
        return self.usable & ~self.fit

    @property
    def fit(self) -> NDArray[np.bool_]:
        """The samples to fit on, which prepare() always marks, (n,)."""
        return cast("NDArray[np.bool_]", self.measurement.fit)

    @property
    def noise_psd(self) -> Samples:
        """The fan's PSD, which prepare() always knows, (601,)."""
        return cast(Samples, self.measurement.noise_psd)

    def fitted_to(self, fit: NDArray[np.bool_]) -> Straightened:
        """The same with other samples to fit on, (n,)."""
        return replace(self, measurement=replace(self.measurement, fit=fit))

    def behind(self, model: EchoModel) -> Straightened:
        """The same recording, whitened by the fan that a model expects; itself where both models expect the same fan."""
        was, now = (each.expected_noise(self.noise_psd) for each in (self.model, model))
        if np.array_equal(was, now):
            return self
        psd = floored(self.noise_psd * (now / was)).astype(np.float32)
        if (key := psd.tobytes()) not in self._behind:
            self._behind[key] = replace(self, measurement=replace(self.measurement, noise_psd=psd), model=model)
        return self._behind[key]

    def fitted(self, name: str, model: EchoModel) -> dict[str, float | Array]:
        """Fit an effect that the model lacks, against the noise that the model expects; all its values.

        An effect that comes before a clock drift is fitted to the recording without the drift.
        """
        here = self.behind(model)
        if model.still is model or STAGES.index(find(name).stage) >= STAGES.index("time"):
            return model.fitted(name, here.measurement)
        read = model.read_at(self.usable.size)
        if (key := read.tobytes()) not in here._unmoved:
            here._unmoved[key] = here._without(read)
        return model.still.fitted(name, here._unmoved[key])

    def _without(self, read: Array) -> Measurement:
        """The measurement with its recording unwarped: sample i of the warped recording was read at position read[i], (n,)."""
        n = np.arange(read.size)
        at = np.interp(n, read, n)
        # at twice the sampling rate, at which the interpolation filter passes the whole band
        spectrum = fft.rfft(np.pad(self.measurement.recording, (0, SPAN)))
        twice = fft.irfft(2.0 * spectrum, 2 * (n.size + SPAN))[: 2 * n.size].astype(np.float32)
        moved, fit = interpolate(twice, 2.0 * at), self.fit[np.rint(at).astype(int)]
        return replace(self.measurement, recording=moved, fit=fit)

    @cached_property
    def starts(self) -> NDArray[np.signedinteger]:
        """First sample of each held-out cell, (times,)."""
        starts = np.arange(0, self.usable.size - SPAN + 1, STEP)
        return starts[_within(self.held_out, starts) >= 0.9 * SPAN]

    @cached_property
    def active_cells(self) -> NDArray[np.bool_]:
        """Mask of the times at which the robot is heard, (times,) bool."""
        return _within(self.active, self.starts) > 0.3 * SPAN

    @property
    def silent_cells(self) -> NDArray[np.bool_]:
        """Mask of the times at which it is not, (times,) bool; all False where they are too few to tell."""
        silent = ~self.active_cells
        return silent & (np.count_nonzero(silent) >= FEWEST)

    def cells(self, residual: Samples) -> Array:
        """Power of the residual (n,) over the fan's, in the held-out cells, (times, bands)."""
        at = self.starts[:, None] + np.arange(FRAMES_PER_CELL) * HOP
        read = frames(residual, FRAME, 1)[at] * _window()
        return _by_band(fourier.power(fft.rfft(read, axis=-1)).mean(axis=1) / self._fan_bins)

    def of(self, model: EchoModel, any_volume: bool = False) -> Score:
        """The score of what a model predicts, in the noise that it expects. any_volume: with the voice at the volume that fits best.

        That is the fan, as what is at the microphone lets it through, and what no waveform predicts. The ordinary
        tolerances are taken up first. A gain of the microphone, which the fan passed as well, is taken out of the residual
        before that is held against the fan. The cells keep it: as a likelihood their level has to be that of the recording
        as it is.
        """
        here = self.behind(model)
        measurement, reference = here.measurement, here.measurement.reference
        voice, white = measurement.predicted(model)
        if any_volume:
            volume = np.float32(
                level_ratio(measurement.white_recording * measurement.weights, white * measurement.weights)
            )
            voice, white = volume * voice, volume * white
        corrected = here.correct(voice, white)
        unpredictable = model.unpredictable(reference)
        fan, gain = model.fan(here._fan), model.microphone_gain(self.usable.size)
        passed = model.passed(fan, reference)
        residual = measurement.recording - corrected
        expected = (*unpredictable, *self.ordinary)
        variance = here._expected_cells(expected)
        plain = measurement.whiten(residual / gain).astype(np.float64) ** 2
        if passed is not here._fan:
            variance = variance * (here.cells(passed + here._rounding) / here._fan_cells)
        if fan is not here._fan:
            plain = plain + (1.0 - measurement.whiten(fan).astype(np.float64) ** 2)
        power = here._over_expected(plain, expected) if expected else plain
        cells = here.cells(residual) / variance
        levels = decibels(0.5 + 0.5 * cells)
        over_db = _mean(levels)
        louder = _by_band(here._fan_bins / self._fan_bins)
        cost_db = _mean(0.5 * decibels(variance * louder / self._ordinary_cells))
        held, active = self.held_out, self.active
        return Score(
            level_db=over_db + cost_db,
            over_db=over_db,
            floor_db=_mean(levels[self.silent_cells]),
            excess_db=_db(power[held]),
            active_db=_db(power[held & active]),
            silent_db=_db(power[held & ~active]),
            irreducible_db=_db(plain[held]) if unpredictable else 0.0,
            cells=cells,
            prediction=corrected,
        )

    def silences_db(self, score: Score) -> float:
        """By how much the robot's silences, or all where it is never silent, are louder than expected, dB."""
        power = _mean(score.cells[self.silent_cells] if self.silent_cells.any() else score.cells)
        return float(decibels(power)) if power > 0.0 else 0.0

    def correct(self, prediction: Samples, white: Samples) -> Samples:
        """A prediction, also given whitened, through the filter, within TOLERANCE of 1, that brings it closest to the recording."""
        target, lead = self.measurement.white_recording - white, TOLERANCE_TAPS // 2
        rows = self.fit & self.usable & self.active & (np.arange(self.usable.size) % 3 == 0)
        response = np.fft.rfft(fitted_taps(white, target, TOLERANCE_TAPS, lead, rows, 1e-5), 256)
        bounded = np.fft.irfft(response * np.minimum(1.0, TOLERANCE / np.maximum(np.abs(response), 1e-12)), 256)
        return prediction + filtered(prediction, np.roll(bounded, 96), 96 + lead)

    @cached_property
    def _fan(self) -> Samples:
        """A sound like the fan, (n,)."""
        return coloured(np.random.default_rng(0), self.usable.size, self.noise_psd).astype(np.float32)

    @cached_property
    def _rounding(self) -> Samples:
        """What the rounding to 16 bit leaves where nothing else is heard, (n,)."""
        return coloured(np.random.default_rng(1), self.usable.size, np.full(GRID_BINS, ROUNDING_PSD)).astype(np.float32)

    @cached_property
    def _fan_bins(self) -> Array:
        """The fan's power in each bin of a frame, (FRAME / 2 + 1,)."""
        return variance_at(frequencies(FRAME // 2 + 1), self.noise_psd) * float(np.sum(_window() ** 2))

    @cached_property
    def _fan_cells(self) -> Array:
        """Power of a sound like the fan in the held-out cells, (times, bands)."""
        return self.cells(self._fan)

    @cached_property
    def _ordinary_cells(self) -> Array:
        """What is expected over the fan where nothing is missing, (times, bands)."""
        return self._expected_cells(self.ordinary)

    def _expected_cells(self, unpredictable: Sequence[tuple[Samples, Array]]) -> Array:
        """What is expected in the held-out cells, 1 where that is the fan alone, (times, bands)."""
        expected = np.ones((self.starts.size, bands().freedom.size))
        for variance, colour in unpredictable:
            places = np.arange(FRAME // 2 + 1) * (colour.size - 1) / (FRAME // 2)
            share = np.interp(places, np.arange(colour.size), colour / self.noise_psd)
            expected = expected + (_within(variance, self.starts) / SPAN)[:, None] * _by_band(share)
        return expected

    def _over_expected(self, power: Array, unpredictable: Sequence[tuple[Samples, Array]]) -> Array:
        """Power of the whitened residual over what is expected, (n,), smoothed over 16 ms: a knock is known to some ms."""
        expected = np.ones_like(power)
        for variance, colour in unpredictable:
            expected += variance * float(np.mean(colour / self.noise_psd))
        return uniform_filter1d(power, HOP) / uniform_filter1d(expected, HOP)


def share_of(before_db: float, after_db: float) -> float:
    """Part of the power over the fan that is gone."""
    before, after = 10 ** (before_db / 10) - 1.0, 10 ** (after_db / 10) - 1.0
    return float(np.clip(1.0 - after / before, 0.0, 1.0)) if before > 0.0 else 0.0


def _db(power: Array) -> float:
    return float(decibels(np.mean(power))) if power.size else 0.0


@cache
def _window() -> Samples:
    return hann(FRAME).astype(np.float32)


def _within(x: NDArray[np.generic], starts: NDArray[np.integer]) -> Array:
    """The sum of x (n,) over the cell from each start on, (starts,)."""
    total = np.cumsum(np.append(0.0, block_sums(x, HOP)))  # cells begin and end with a hop
    return np.asarray(total[(starts + SPAN) // HOP] - total[starts // HOP])


def _mean(cells: Array) -> float:
    """Mean of values (times, bands), each cell weighted by its degrees of freedom; 0 of no cells."""
    return float(np.average(cells.mean(axis=0), weights=bands().freedom)) if cells.size else 0.0


def _by_band(spectra: Array) -> Array:
    """Means of spectra (..., FRAME / 2 + 1) over the bins of each band, (..., bands)."""
    bins, _, freedom = bands()
    return np.add.reduceat(spectra[..., : bins[-1]], bins[:-1], axis=-1) / freedom
