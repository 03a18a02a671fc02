"""How far what a model predicts of the robot's own voice is from a recording of it, and where."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from edgefilter.diagnosis.independence import Independence, independence
from edgefilter.diagnosis.straightened import Score, Straightened
from edgefilter.dsp.frames import block_power, blocks, decibels, frames
from edgefilter.dsp.psd import frequencies, periodograms, total_power
from edgefilter.echo.effects.catalogue import chain
from edgefilter.echo.measurement import whiten
from edgefilter.echo.model import EchoModel, through
from edgefilter.echo.recording import BLOCK
from edgefilter.types import SAMPLE_RATE, Array, Samples

BAND_EDGES = (60.0, 125.0, 250.0, 500.0, 1000.0, 1500.0, 2000.0, 3000.0, 4000.0, 5000.0, 6000.0, 7000.0, 7800.0)
LEVEL_STEP_DB = 6.0
LAG_EDGES_MS = (-20.0, -4.0, 0.0, 4.0, 10.0, 30.0, 100.0, 200.0, 400.0, 800.0)

Rows: TypeAlias = tuple[tuple[float, float, float], ...]
"""Low, high and a value, one range after the other."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """A recording against its prediction.

    Excess is the power of the residual over the fan's, dB, both whitened by the fan's PSD.

    excess_db: over the samples that no fit has used, alternate half seconds, as Straightened scores them: the one figure that
    compare, add, diagnose and the report show; 0 means that nothing is unexplained. All else is over the whole recording.
    noise_floor_db: the fan, dB re full scale. bands: (low_hz, high_hz, excess_db). times: (start_s, end_s, excess_db).
    levels: (low_dbfs, high_dbfs, excess_db) by the level of the predicted voice. lags: (low_ms, high_ms, share) of the
    residual's correlation with the reference, by lag. silence_excess_db: while the robot is silent; nan where it never
    is. human: (start_s, end_s) that are left out, since somebody talks. offset_samples: constant lag of the recording
    relative to the calibration. recording, prediction, residual: (n,), aligned. independence: whether the residual is white
    and independent of the reference; None where the robot talks for less than a second. drift_ppm: how much faster the microphone's
    clock runs than the reference's, where that is taken out.
    """

    excess_db: float
    noise_floor_db: float
    bands: Rows
    times: Rows
    levels: Rows
    lags: Rows
    silence_excess_db: float
    human: tuple[tuple[float, float], ...]
    offset_samples: float
    warnings: tuple[str, ...]
    recording: Samples = field(repr=False)
    prediction: Samples = field(repr=False)
    residual: Samples = field(repr=False)
    independence: Independence | None = field(default=None, repr=False)
    drift_ppm: float = 0.0

    def to_dict(self) -> dict[str, object]:
        """All but the signals, ready for JSON."""
        told = {entry.name: rounded(getattr(self, entry.name)) for entry in fields(self) if entry.repr}
        return {**told, "independence": self.independence.to_dict() if self.independence else None}


def rounded(value: Any, digits: int = 4) -> Any:
    """A value, or all in it, ready for JSON: numbers to so many digits behind the point, None where one is not finite."""
    if isinstance(value, dict):
        return {key: rounded(one, digits) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [rounded(one, digits) for one in value]
    if isinstance(value, float | np.floating):
        return round(float(value), digits) if np.isfinite(value) else None
    return value


def describe(prepared: Straightened, model: EchoModel, score: Score | None = None) -> Comparison:
    """The comparison of a prepared recording with what a model predicts; score: of that model, where it is known.

    A gain of the microphone is taken out of the residual before that is held against the fan, which passed it as well.
    """
    score, prepared = score or prepared.of(model), prepared.behind(model)
    measurement, prediction = prepared.measurement, score.prediction
    residual = measurement.recording - prediction
    psd = prepared.noise_psd
    flat = residual / model.microphone_gain(residual.size)
    white = whiten(flat, psd)
    use = prepared.usable
    power = np.where(use, white.astype(np.float64) ** 2, np.nan)
    silence = power[use & ~prepared.active]
    return Comparison(
        excess_db=score.excess_db,
        noise_floor_db=float(decibels(total_power(psd))),
        bands=_by_band(flat, psd, use),
        times=tuple(
            (
                at / SAMPLE_RATE,
                min(at + BLOCK, use.size) / SAMPLE_RATE,
                float(decibels(np.nanmean(power[at : at + BLOCK]))),
            )
            for at in range(0, use.size, BLOCK)
            if use[at : at + BLOCK].any()
        ),
        levels=_by_level(prediction, whiten(prediction, psd), power),
        lags=_by_lag(white * use, whiten(measurement.reference, psd)),
        silence_excess_db=float(decibels(np.mean(silence))) if silence.size > SAMPLE_RATE // 10 else float("nan"),
        human=prepared.human,
        offset_samples=prepared.offset,
        warnings=prepared.warnings,
        recording=measurement.recording,
        prediction=prediction,
        residual=residual,
        independence=independence_of(prepared, model, score),
    )


def independence_of(prepared: Straightened, model: EchoModel, score: Score) -> Independence | None:
    """Whether a model's residual tells nothing of the reference any more: `independence`, or None like it. score: of that model."""
    prepared = prepared.behind(model)
    measurement, use, active = prepared.measurement, prepared.usable, prepared.active
    flat = (measurement.recording - score.prediction) / model.microphone_gain(measurement.recording.size)
    ahead = [pair for pair in chain(model.effects) if pair[0].stage in ("source", "time")]
    played = through(ahead, measurement.reference)  # by the loudspeaker, with the clock's drift
    return independence(flat, played, prepared.noise_psd, use & active, use & ~active)


def _by_band(residual: Samples, psd: Samples, use: NDArray[np.bool_]) -> Rows:
    """Mean PSD of the residual in each band over the fan's."""
    size = 2 * (psd.size - 1)
    whole = frames(use, size, size // 2).all(axis=1)
    if not whole.any():
        return ()
    hz = frequencies(psd.size)
    ratio = np.mean(periodograms(residual, size)[whole], axis=0) / psd
    return tuple(
        (low, high, float(decibels(np.mean(ratio[(hz >= low) & (hz < high)])))) for low, high in pairwise(BAND_EDGES)
    )


def _by_level(prediction: Samples, white: Samples, power: Array) -> Rows:
    """Excess by the level of the predicted voice in blocks of 20 ms in which it, whitened, is no less than the fan."""
    block = SAMPLE_RATE // 50
    level, excess = decibels(block_power(prediction, block)), blocks(power, block).mean(axis=1)
    steps = np.floor(level / LEVEL_STEP_DB)
    audible = np.isfinite(excess) & (block_power(white, block) >= 1.0)
    found = []
    for step in np.unique(steps[audible]):
        inside = (steps == step) & audible
        if inside.sum() >= 5:
            low, high = float(step * LEVEL_STEP_DB), float((step + 1) * LEVEL_STEP_DB)
            found.append((low, high, float(decibels(np.mean(excess[inside])))))
    return tuple(found)


def _by_lag(white: Samples, reference: Samples) -> Rows:
    """Share of the squared cross-correlation of residual and reference in each range of lags, both spectra flattened."""
    n = fft.next_fast_len(2 * white.size, real=True)
    a, b = fft.rfft(white, n), fft.rfft(reference, n)
    power = np.abs(b) ** 2
    cross = fft.irfft(a * np.conj(b) / (power + 1e-2 * np.mean(power)), n)
    edges = pairwise(round(ms * SAMPLE_RATE / 1000) for ms in LAG_EDGES_MS)
    parts = np.array([np.sum(np.take(cross, np.arange(low, high), mode="wrap") ** 2) for low, high in edges])
    shares = parts / max(parts.sum(), 1e-30)
    return tuple((low, high, float(share)) for (low, high), share in zip(pairwise(LAG_EDGES_MS), shares, strict=True))
