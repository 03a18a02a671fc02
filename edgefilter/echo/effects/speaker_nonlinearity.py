"""A loudspeaker driven hard: it adds harmonics and intermodulation."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from edgefilter.dsp.membrane import DISPLACEMENT_TAPS, displacement_taps
from edgefilter.echo.effect import Effect, Parameter, Stage, first, number_or_taps
from edgefilter.echo.least_squares import NUISANCE_LEAD, filtered, normal_equations, short_filter
from edgefilter.echo.measurement import Measurement, Values, VoiceModel, level_ratio
from edgefilter.types import SAMPLE_RATE, Samples

TAPS = 16
"""Taps of the filter behind each nonlinear function, where one number each is not enough."""
RIDGE = 1e-3
BOUND = 1e4
SILENT_DB = -120.0
TERMS = ("even", "odd", "saturation", "force_factor", "stiffness")


def displacement(x: Samples, sample_rate: int = SAMPLE_RATE) -> Samples:
    """The membrane's displacement (n,) for the drive x (n,), in its full scale."""
    return short_filter(x, displacement_taps(sample_rate).astype(np.float32))[: x.size] if x.size else x.copy()


def distortion_terms(x: Samples, sample_rate: int = SAMPLE_RATE) -> dict[str, Samples]:
    """Each of TERMS as a signal (n,) for a drive x (n,): x^2, x^3, x |x|, d x, d^2 x with the displacement d."""
    d = displacement(x, sample_rate)
    return {"even": x * x, "odd": x * x * x, "saturation": x * np.abs(x), "force_factor": d * x, "stiffness": d * d * x}


class SpeakerNonlinearity(Effect):
    """y = x + sum of h_k * f_k(x), five nonlinear functions f_k ahead of the linear path, each with a filter h_k of its own.

    A parallel Hammerstein model (Novak et al. 2010, "Nonlinear system identification using exponential swept-sine
    signals") whose functions are x^2, x^3 and x |x| for amplifier and membrane, and the products d x, d^2 x with the
    displacement d: the terms that force factor and stiffness add when they depend on the displacement (Klippel 2006,
    "Loudspeaker nonlinearities"). A parameter is one number or the taps (t,) of a causal filter, per full scale. Valid
    while the added terms are well below x.
    """

    name: ClassVar[str] = "speaker_nonlinearity"
    stage: ClassVar[Stage] = "source"
    title: ClassVar[str] = "loudspeaker nonlinearity"
    flexible: ClassVar[bool] = True
    learned: ClassVar[bool] = True
    memory: ClassVar[int | None] = DISPLACEMENT_TAPS + TAPS
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("even", "1/full scale", 0.0, -BOUND, BOUND),
        Parameter("odd", "1/full scale^2", 0.0, -BOUND, BOUND),
        Parameter("saturation", "1/full scale", 0.0, -BOUND, BOUND),
        Parameter("force_factor", "1/full scale", 0.0, -BOUND, BOUND),
        Parameter("stiffness", "1/full scale^2", 0.0, -BOUND, BOUND),
        Parameter("level_db", "dB re the linear voice at the microphone", SILENT_DB, SILENT_DB, 20.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """X (n,) with its distortion; level_db only reports."""
        taps = {name: np.atleast_1d(np.asarray(values[name], float)) for name in TERMS}
        out = x.copy()
        if any(h.any() for h in taps.values()):
            for name, term in distortion_terms(x, sample_rate).items():
                out += filtered([term], taps[name][None])
        return out

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Ridge regression of the whitened recording on the path-filtered terms and the voice itself, with its nuisance filter.

        One number for each term, or a filter for each where Bayes' information criterion says that they pay.
        """
        x = measurement.reference
        terms = distortion_terms(x)
        linear = measurement.heard(model)[1]
        early = np.concatenate((linear[NUISANCE_LEAD:], np.zeros(NUISANCE_LEAD, np.float32)))[: linear.size]
        columns = [early] + [measurement.whiten(model.predict(terms[name])) for name in TERMS]
        target = measurement.white_recording
        normal = normal_equations(columns, target, TAPS, 0, measurement.fit)
        weights, left = normal.solve(RIDGE)
        single = np.zeros(weights.shape, bool)
        single[0], single[1:, 0] = True, True
        simple, left_by_simple = normal.solve(RIDGE, single)
        taps = TAPS
        variance = max(left / max(normal.count, 1), 1e-30)
        if (left_by_simple - left) / variance < (~single).sum() * np.log(max(normal.count, 2)):
            weights, taps = simple, 1
        gain = level_ratio(filtered(columns[:1], weights[:1]), linear) or 1.0
        added = filtered(columns[1:], weights[1:])
        added = added - level_ratio(added, linear) * linear
        level = 10.0 * np.log10(float(np.mean(added**2)) / (float(np.mean(linear**2)) + 1e-30) + 1e-12)
        values = {
            name: number_or_taps(np.clip(w[:taps] / gain, -BOUND, BOUND))
            for name, w in zip(TERMS, weights[1:], strict=True)
        }
        return {**values, "level_db": float(np.clip(level, SILENT_DB, 20.0))}

    def sentence(self, values: Values) -> str:
        """How strong the distortion is."""
        level_db = first(values, "level_db")
        return (
            f"products of the reference with itself, {level_db:.0f} dB re the voice, are in the residual: no linear"
            " path makes them"
        )
