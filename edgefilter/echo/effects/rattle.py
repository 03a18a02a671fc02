"""Something loose on the robot: it knocks when the membrane moves too far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.convolution import convolve, filtered
from edgefilter.dsp.frames import frames
from edgefilter.echo.effect import NEVER_REACHED, Effect, Parameter, complete, first, neutral, numbers, within
from edgefilter.echo.effects.knock_power import (
    DECAYS_MS,
    FOLD,
    FRAME,
    HOP,
    RESONANCES_HZ,
    Trigger,
    band_power,
    colour_of,
    density_of,
    fan_in_bands,
    find_knocks,
    find_trigger,
    frames_to_fit,
    knocks_in,
    one_side,
    quantiles_of_peaks,
    resonated,
    ringing_of,
    rises,
)
from edgefilter.echo.least_squares import absorbed
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.types import SAMPLE_RATE, Array, Samples

TAPS = 320
"""20 ms of ringing after a knock."""
RIDGE = 1e-2
"""Regularisation of the fit of a knock's impulse response, relative to the energy of the pulses that excite it: a voice sets off knocks
so close together that neighbouring taps are almost collinear."""
WORTH = 2.5
"""What each tap has to explain, in units of the residual's variance, for the sounds to be real."""
ANYWHERE = [Trigger(hz, q, NEVER_REACHED, 0.0) for hz, q in product(RESONANCES_HZ, (0.7, 1.0, 1.6))]
NEAR = (0.7, 0.8, 0.9, 0.96, 1.0, 1.04, 1.1, 1.2, 1.35)
"""Membranes on which the trigger is looked for anew, either side knocking, and then thresholds re the one that was found."""
REFINED = 3
"""Times at most that the trigger is looked for anew with the sounds found."""


class Rattle(Effect):
    """y = x + h * k: a knock k at every moment at which the displacement |d| rises through threshold, h its sound, ahead of the path.

    d is the drive through the membrane's resonance, w^2 / (s^2 + s w / q + w^2). An impact excites the modes of the
    loose part in proportion to the speed at which it is hit (Klippel 2006, "Loudspeaker nonlinearities", irregular
    distortion), so a knock is as high as d' per ms over threshold: outward (t,) taps is the sound of pushes, inward
    that of pulls. threshold: full scale of the drive. side: 1 where only pushes knock, -1 only pulls, 0 both. No two
    knocks are alike: what no waveform predicts is noise that starts at each knock, with power (16,) in bands of 500 Hz
    for a height of 1, and decays in decay_ms. rate_hz, knocks per second, only reports.
    """

    name = "rattle"
    stage = "source"
    family = "additive noise"
    title = "a rattle"
    memory = 2048
    parameters = (
        Parameter("threshold", "full scale", NEVER_REACHED, 1e-5, NEVER_REACHED),
        Parameter("resonance_hz", "Hz", 200.0, 20.0, 2000.0),
        Parameter("q", "", 1.0, 0.1, 20.0),
        Parameter("side", "", 0.0, -1.0, 1.0),
        Parameter("outward", "", 0.0, -1e4, 1e4),
        Parameter("inward", "", 0.0, -1e4, 1e4),
        Parameter("power", "full scale^2", 0.0, 0.0, 1.0),
        Parameter("decay_ms", "ms", 5.0, 0.1, 1000.0),
        Parameter("rate_hz", "1/s", 0.0, 0.0, 8000.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        sounds = [numbers(values, name) for name in ("outward", "inward")]
        if not any(h.any() for h in sounds):
            return x.copy()
        knocks = _trains(x, values, sample_rate)
        return x + sum(filtered(k, h) for k, h in zip(knocks, sounds, strict=True))

    def variance(self, reference: Samples, values: Values, sample_rate: int) -> Samples:
        knocks = one_side(_trains(reference, values, sample_rate), float(values["side"]))
        return float(np.sum(values["power"])) * ringing_of(knocks, float(values["decay_ms"]), sample_rate)

    def colour(self, values: Values) -> Array:
        return density_of(values["power"])

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """What sets the knocks off, by when the residual is loud; then the least-squares sounds, and the power of the rest.

        Where the sounds explain something, they serve as matched filters, which show how hard the robot was hit at each
        moment, and resonance, q and threshold are refined by these. Neutral where the residual follows the voice's
        level rather than knocks, unless sounds learnt from some knocks explain others, and more than as long a linear
        filter of the voice does.
        """
        x = measurement.reference
        predicted, target = measurement.predicted(model)[1], measurement.white_recording
        left = target - absorbed(predicted, target, measurement.fit)
        trigger, told = find_trigger(x, left, predicted, measurement.fit)
        if trigger is None:
            return neutral(self)
        rest, allowed = left * measurement.weights, _roomy(measurement)

        def knocks_of(at: Trigger) -> list[Samples]:
            both = zip(_trains(x, asdict(at), SAMPLE_RATE), (1.0, -1.0), strict=True)
            return [train * allowed if at.side * way >= 0.0 else np.zeros_like(train) for train, way in both]

        def explain(at: Trigger) -> tuple[float, Array]:
            return _explained([measurement.heard(model, k) for k in knocks_of(at)], rest, TAPS)

        at, (gain, sounds) = trigger, explain(trigger)
        for again in range(REFINED):
            hits = [
                _matched(sound, rest, measurement, model) * allowed if sound.any() else allowed[:0] for sound in sounds
            ]
            other = _best_agreement(x, hits, _near(at), NEAR) if again else _best_agreement(x, hits, ANYWHERE)
            gain_then, sounds_then = explain(other)
            if gain_then > gain:
                at, gain, sounds = other, gain_then, sounds_then
            elif again:
                break
        halves = np.arange(x.size) // FOLD % 2 == 0
        worth = WORTH * sounds.size * float(np.dot(rest, rest)) / max(float(measurement.weights.sum()), 1.0)
        if not told:  # as long a filter of the voice must not do as much
            worth = max(worth, _explained([predicted * measurement.weights], rest, 2 * TAPS)[0])
        if gain <= worth or not _predicts([(k * halves, k * ~halves) for k in knocks_of(at)], rest, measurement, model):
            if not told:
                return neutral(self)
            at, sounds = trigger, np.zeros(2)
        values = within(self, {**asdict(at), "outward": sounds[0], "inward": sounds[1]})
        return within(self, {**values, **self._unpredictable(measurement, model, values)})

    def _unpredictable(self, measurement: Measurement, model: VoiceModel, values: Values) -> Values:
        """Fit power, decay_ms and rate_hz to what the predictable knocks leave."""
        x = measurement.reference
        knocks = one_side(_trains(x, values, SAMPLE_RATE), float(values["side"]))
        predicted = measurement.heard(model, self.apply(x, complete(self, values), SAMPLE_RATE))
        target = measurement.white_recording
        over = band_power(target - absorbed(predicted, target, measurement.fit))
        use, fits = frames_to_fit(measurement.fit, len(over)), {}
        for decay in DECAYS_MS:
            source = frames(ringing_of(knocks, decay), FRAME, HOP).mean(axis=1, keepdims=True)
            fits[decay] = colour_of(over, source, use)
        decay = max(fits, key=lambda decay: fits[decay][0])
        power = fits[decay][1] * fan_in_bands(measurement.noise_psd)
        rate = np.count_nonzero(knocks) * SAMPLE_RATE / max(x.size, 1)
        return {"power": power, "decay_ms": decay, "rate_hz": rate}

    def sentence(self, values: Values) -> str:
        side = {1.0: "outward", -1.0: "inward"}.get(first(values, "side"), "far")
        return (
            f"short bursts, {first(values, 'rate_hz'):.0f} a second, follow the moments at which the membrane is driven"
            f" {side}, and not the voice's level; what of them no waveform predicts is shown as irreducible"
        )


def _trains(x: Samples, values: Values, sample_rate: int) -> tuple[Samples, Samples]:
    """Impulses, (n,) each, of a loose part that x (n,) drives: where it knocks on its way out, and where on its way in."""
    moved = resonated(x, float(values["resonance_hz"]), float(values["q"]), sample_rate)
    return find_knocks(moved, float(values["threshold"]))


def _roomy(measurement: Measurement) -> np.ndarray:
    """Where a knock can ring for TAPS and on through the path within samples to fit on, (n,) bool."""
    if measurement.fit is None:
        return np.ones(measurement.recording.size, bool)
    ring = 2 * TAPS
    total = np.cumsum(np.pad(measurement.fit, (0, ring)))
    return np.asarray(total[ring:] - total[:-ring] >= ring)


def _matched(sound: Array, rest: Samples, measurement: Measurement, model: VoiceModel) -> Samples:
    """Correlation of the residual with the whitened sound of one knock at the microphone, (n,)."""
    length, at = 4096, 1024
    knock = np.zeros(length, np.float32)
    knock[at : at + sound.size] = sound
    heard = measurement.heard(model, knock)
    return convolve(rest, heard[::-1])[length - 1 - at :][: rest.size].astype(np.float32)


def _near(at: Trigger) -> list[Trigger]:
    """The trigger, and such whose membrane resonates at a slightly other frequency or with another quality."""
    steps = product((0.85, 0.92, 0.96, 1.0, 1.04, 1.09, 1.18), (0.75, 1.0, 1.3))
    return [replace(at, resonance_hz=at.resonance_hz * a, q=at.q * b) for a, b in steps]


def _best_agreement(x: Samples, hits: list[Samples], membranes: list[Trigger], shares: Sequence[float] = ()) -> Trigger:
    """The one whose knocks fit the matched filter's output best, of thresholds that are shares of each one's own, or of its peaks."""
    best, most = membranes[0], -np.inf
    for one in membranes:
        moved = resonated(x, one.resonance_hz, one.q)
        thresholds = [one.threshold * share for share in shares] or quantiles_of_peaks(moved)
        sides = rises(moved, min(thresholds))
        for threshold in thresholds:
            agreement = _agreement([knocks_in(rising, threshold) for rising in sides], hits)
            if agreement > most:
                best, most = replace(one, threshold=threshold), agreement
    return best


def _agreement(knocks: list[tuple[NDArray[np.integer], Samples]], hits: list[Samples]) -> float:
    """How much of the residual's energy knocks of these heights explain, in units of one knock's energy, overlaps neglected."""
    heard = [(height, hit[at]) for (at, height), hit in zip(knocks, hits, strict=True) if hit.size]
    along, energy = sum(float(np.dot(k, hit)) for k, hit in heard), sum(float(np.dot(k, k)) for k, _ in heard)
    return along * abs(along) / energy if energy > 0.0 else 0.0


def _predicts(
    halves: list[tuple[Samples, Samples]], residual: Samples, measurement: Measurement, model: VoiceModel
) -> bool:
    """Whether the sounds learnt from one half of the knocks explain some of the other half, both ways round."""
    heard = [[measurement.heard(model, knocks) for knocks in half] for half in zip(*halves, strict=True)]
    normals = [_normal(half, residual, TAPS) for half in heard]
    total = 0.0
    for (matrix, right), (other, wanted) in (normals, normals[::-1]):
        w = _solve(matrix, right)
        total += float(2 * w @ wanted - w @ other @ w)
    return total > 0.0


def _explained(columns: list[Samples], residual: Samples, taps: int) -> tuple[float, Array]:
    """Energy explained and weights (C, taps) of residual = sum of columns filtered by so many taps."""
    matrix, right = _normal(columns, residual, taps)
    w = _solve(matrix, right)
    return float(2 * w @ right - w @ matrix @ w), w.reshape(len(columns), taps)


def _solve(matrix: Array, right: Array) -> Array:
    scale = float(matrix.diagonal().mean())
    if scale <= 0.0:
        return np.zeros_like(right)
    return scipy.linalg.solve(matrix + RIDGE * scale * np.eye(right.size), right, assume_a="pos")


def _normal(columns: list[Samples], residual: Samples, taps: int) -> tuple[Array, Array]:
    """Normal equations (C taps, C taps), (C taps,) from correlations: for many taps faster than by normal_equations()."""
    n = scipy.fft.next_fast_len(residual.size + taps, real=True)
    spectra = [scipy.fft.rfft(c, n) for c in columns]
    target = scipy.fft.rfft(residual, n)
    right = np.concatenate([scipy.fft.irfft(np.conj(s) * target, n)[:taps] for s in spectra])
    lags = [[scipy.fft.irfft(np.conj(a) * b, n) for b in spectra] for a in spectra]
    square = [[scipy.linalg.toeplitz(r[:taps], np.append(r[:1], r[:-taps:-1])) for r in row] for row in lags]
    return np.block(square), right
