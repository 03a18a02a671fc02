"""Something loose on the robot: it knocks when the membrane moves too far."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import scipy

from edgefilter.echo.effect import Measurement, Parameter, Stage, Values, complete, neutral
from edgefilter.echo.least_squares import absorbed, filtered
from edgefilter.types import SAMPLE_RATE, Array, Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel

TAPS, COARSE_TAPS = 320, 96
"""20 ms of ringing after a knock; 6 ms are enough to find out what sets it off."""
DIRECT = 64
"""Samples before the direct sound in the path's impulse response (model.PRE_ROLL)."""
NEVER = 100.0
BOUND = 1e4
RIDGE = 1e-2
STARTS_HZ, START_SHARES = (160.0, 240.0), (0.5, 0.75)
"""First guesses: resonance, and threshold as the share of the displacement's peaks that stay below."""
HALF = SAMPLE_RATE
"""Samples of the stretches that take turns when the sounds are tried on knocks that they were not learnt from."""
WORTH = 2.5
"""What each tap has to explain, in units of the residual's variance, for the knocks to be real."""
DECAYS_MS = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)


class Rattle:
    """y = x + h * k: a knock k at every moment at which the displacement |d| rises through threshold, h its sound, ahead of the path.

    d is the drive through the membrane's resonance, w^2 / (s^2 + s w / q + w^2). An impact excites the modes of the loose part in
    proportion to the speed at which it is hit (Klippel 2006, "Loudspeaker nonlinearities", irregular distortion), so a knock is as
    high as d' per ms over threshold: outward (t,) taps is the sound of pushes, inward that of pulls. threshold: full scale of the
    drive. No two knocks are alike: power and decay_ms say what variance() adds. rate_hz, knocks per second, only reports.
    """

    name: ClassVar[str] = "rattle"
    stage: ClassVar[Stage] = "source"
    memoryless: ClassVar[bool] = False
    memory: ClassVar[int] = 1024
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("threshold", "full scale", NEVER, 1e-5, NEVER),
        Parameter("resonance_hz", "Hz", 200.0, 20.0, 2000.0),
        Parameter("q", "", 1.0, 0.1, 20.0),
        Parameter("outward", "", 0.0, -BOUND, BOUND),
        Parameter("inward", "", 0.0, -BOUND, BOUND),
        Parameter("power", "full scale^2", 0.0, 0.0, 1.0),
        Parameter("decay_ms", "ms", 5.0, 0.1, 1000.0),
        Parameter("rate_hz", "1/s", 0.0, 0.0, 8000.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """x (n,) and its knocks."""
        sounds = [np.atleast_1d(np.asarray(values[name], float)) for name in ("outward", "inward")]
        if not any(h.any() for h in sounds):
            return x.copy()
        knocks = find_knocks(resonated(x, float(values["resonance_hz"]), float(values["q"]), sample_rate), float(values["threshold"]))
        return x + sum(filtered([k], h[None]) for k, h in zip(knocks, sounds, strict=True))

    def variance(self, reference: Samples, values: Values, sample_rate: int) -> Samples:
        """What knocks add to the expected square of each sample (n,) at the microphone, for an aligned reference (n,)."""
        power = float(values["power"])
        if power == 0.0:
            return np.zeros_like(reference)
        moved = resonated(reference, float(values["resonance_hz"]), float(values["q"]), sample_rate)
        knocks = np.sum(find_knocks(moved, float(values["threshold"])), axis=0)
        return power * _ringing(knocks, float(values["decay_ms"]), sample_rate)

    def fit(self, measurement: Measurement, model: EchoModel) -> Values:
        """Resonance, q and threshold whose knocks explain most of the whitened residual, with the least-squares sounds.

        Some guesses are fitted with short sounds. The best of these serves as a matched filter, which shows how hard the robot
        was hit at each moment; the resonance, q and threshold whose knocks agree best with that are then fitted in full.
        """
        x = measurement.reference
        predicted, target = measurement.whiten(model.predict(x)), measurement.whiten(measurement.recording)
        rest = (target - absorbed(predicted, target, measurement.fit)) * measurement.weights
        allowed = _roomy(measurement)

        def explain(resonance: float, q: float, threshold: float, taps: int) -> tuple[float, Array]:
            knocks = [k * allowed for k in find_knocks(resonated(x, resonance, q), threshold)]
            return _explained([measurement.whiten(model.predict(k)) for k in knocks], rest, taps)

        starts = [(hz, 1.0, _threshold(resonated(x, hz, 1.0), share)) for hz in STARTS_HZ for share in START_SHARES]
        found = [explain(*start, COARSE_TAPS) for start in starts]
        best = int(np.argmax([gain for gain, _ in found]))
        if found[best][0] <= 0.0:
            return neutral(self)
        at, (gain, sounds) = starts[best], found[best]
        for fine in (False, True):
            hits = [_matched(sound, rest, measurement, model) * allowed for sound in sounds]
            choices = [at, _best_agreement(x, hits, _fine(*at) if fine else _coarse(x))]
            fits = [explain(*choice, TAPS) for choice in choices]
            better = int(fits[1][0] > fits[0][0])
            at, (gain, sounds) = choices[better], fits[better]
        resonance, q, threshold = at
        knocks = [k * allowed for k in find_knocks(resonated(x, resonance, q), threshold)]
        halves = np.arange(x.size) // HALF % 2 == 0
        if gain <= WORTH * sounds.size * float(np.dot(rest, rest)) / max(float(measurement.weights.sum()), 1.0):
            return neutral(self)
        if not _predicts([(k * halves, k * ~halves) for k in knocks], rest, measurement, model):
            sounds = np.zeros_like(sounds)
        values = {"threshold": threshold, "resonance_hz": resonance, "q": q}
        values |= {name: np.clip(sound, -BOUND, BOUND) for name, sound in zip(("outward", "inward"), sounds, strict=True)}
        return {**values, **self._unpredictable(measurement, model, values)}

    def _unpredictable(self, measurement: Measurement, model: EchoModel, values: Values) -> dict[str, float]:
        """power, decay_ms and rate_hz from the square of what the predictable knocks leave."""
        x = measurement.reference
        knocks = np.sum(find_knocks(resonated(x, values["resonance_hz"], values["q"]), values["threshold"]), axis=0)
        predicted = model.predict(self.apply(x, complete(self, values), SAMPLE_RATE))
        square = (measurement.recording - absorbed(predicted, measurement.recording, measurement.fit)).astype(np.float64) ** 2
        square = (square - _fan_power(measurement, square)) * measurement.weights
        best = (0.0, 0.0, 5.0)
        for decay in DECAYS_MS:
            shape = _ringing(knocks, decay, SAMPLE_RATE).astype(np.float64)
            along, energy = float(np.dot(square, shape)), float(np.dot(shape**2, measurement.weights))
            if along > 0.0 and energy > 0.0:
                best = max(best, (along**2 / energy, along / energy, decay))
        return {"power": min(best[1], 1.0), "decay_ms": best[2], "rate_hz": np.count_nonzero(knocks) * SAMPLE_RATE / max(x.size, 1)}


def resonated(x: Samples, resonance_hz: float, q: float, sample_rate: int = SAMPLE_RATE) -> Samples:
    """Displacement (n,) of a membrane with that resonance for the drive x (n,), in its full scale."""
    w = 2.0 * np.pi * resonance_hz
    return scipy.signal.lfilter(*scipy.signal.bilinear([w * w], [1.0, w / q, w * w], sample_rate), x).astype(np.float32)


def find_knocks(moved: Samples, threshold: float) -> tuple[Samples, Samples]:
    """Two pulse trains (n,) for a displacement (n,): where it rises above threshold, and where it falls below -threshold.

    The height is the speed over threshold, per millisecond.
    """
    outward, inward = np.zeros_like(moved), np.zeros_like(moved)
    for train, way in ((outward, moved), (inward, -moved)):
        beyond = way > threshold
        at = 1 + np.flatnonzero(beyond[1:] & ~beyond[:-1])
        train[at] = (way[at] - way[at - 1]) * np.float32(SAMPLE_RATE / 1000 / threshold)
    return outward, inward


def _roomy(measurement: Measurement) -> np.ndarray:
    """(n,) bool: where a knock can ring for TAPS and on through the path within samples to fit on."""
    if measurement.fit is None:
        return np.ones(measurement.recording.size, bool)
    ring = 2 * TAPS
    total = np.concatenate((np.cumsum(measurement.fit), np.full(ring, np.count_nonzero(measurement.fit))))
    return total[ring:] - total[:-ring] >= ring if total.size > ring else np.zeros(measurement.recording.size, bool)


def _threshold(moved: Samples, share: float) -> float:
    """The value that this share of the peaks of |moved| (n,) stays below; peaks under 5 % of the largest do not count."""
    size = np.abs(moved)
    peaks = size[1:-1][(size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])]
    peaks = peaks[peaks > 0.05 * peaks.max()] if peaks.size else peaks
    return float(np.clip(np.quantile(peaks, share), 1e-5, NEVER)) if peaks.size else NEVER


def _ringing(knocks: Samples, decay_ms: float, sample_rate: int) -> Samples:
    """Squared heights of knocks (n,), decaying by 1/e in decay_ms, from the moment at which their direct sound arrives; (n,)."""
    keep = np.exp(-1.0 / (decay_ms * 1e-3 * sample_rate))
    late = np.concatenate((np.zeros(DIRECT), knocks.astype(np.float64) ** 2))[: knocks.size]
    return scipy.signal.lfilter([1.0], [1.0, -keep], late).astype(np.float32)


def _fan_power(measurement: Measurement, square: Array) -> float:
    """The fan's variance, full scale^2; where it is unknown, the quiet tenth of the residual's 20 ms blocks."""
    if measurement.noise_psd is not None:
        return float(measurement.noise_psd.sum()) * SAMPLE_RATE / 2 / (measurement.noise_psd.size - 1)
    blocks = square[: square.size // 320 * 320].reshape(-1, 320).mean(axis=1)
    return float(np.quantile(blocks, 0.1)) if blocks.size else 0.0


def _matched(sound: Array, rest: Samples, measurement: Measurement, model: EchoModel) -> Samples:
    """Correlation (n,) of the residual with the whitened sound of one knock at the microphone."""
    length, at = 4096, 1024
    knock = np.zeros(length, np.float32)
    knock[at : at + sound.size] = sound
    heard = measurement.whiten(model.predict(knock))
    return scipy.signal.oaconvolve(rest, heard[::-1])[length - 1 - at :][: rest.size].astype(np.float32)


def _coarse(x: Samples) -> list[tuple[float, float, float]]:
    """Resonances, qs and thresholds to choose from at first."""
    grid = product((130.0, 165.0, 205.0, 255.0, 320.0), (0.75, 1.2), (0.35, 0.5, 0.62, 0.73, 0.83, 0.93))
    return [(hz, q, _threshold(resonated(x, hz, q), share)) for hz, q, share in grid]


def _fine(resonance: float, q: float, threshold: float) -> list[tuple[float, float, float]]:
    """Neighbours of a choice."""
    steps = product((0.93, 0.97, 1.0, 1.03, 1.07), (0.85, 1.0, 1.18), (0.85, 0.93, 1.0, 1.08, 1.18))
    return [(resonance * a, q * b, threshold * c) for a, b, c in steps]


def _best_agreement(x: Samples, hits: list[Samples], choices: list[tuple[float, float, float]]) -> tuple[float, float, float]:
    """Of (resonance, q, threshold) the one whose knocks fit the matched filter's output best."""
    moved, best = {}, (-np.inf, choices[0])
    for resonance, q, threshold in choices:
        if (resonance, q) not in moved:
            moved = {(resonance, q): resonated(x, resonance, q)}
        best = max(best, (_agreement(find_knocks(moved[resonance, q], threshold), hits), (resonance, q, threshold)))
    return best[1]


def _agreement(knocks: tuple[Samples, Samples], hits: list[Samples]) -> float:
    """How much of the residual's energy knocks of these heights explain, in units of one knock's energy, overlaps neglected."""
    along = sum(float(np.dot(k, hit)) for k, hit in zip(knocks, hits, strict=True))
    energy = sum(float(np.dot(k, k)) for k in knocks)
    return along * abs(along) / energy if energy > 0.0 else 0.0


def _predicts(halves: list[tuple[Samples, Samples]], residual: Samples, measurement: Measurement, model: EchoModel) -> bool:
    """Whether the sounds learnt from one half of the knocks explain some of the other half, both ways round."""
    normals = [_normal([measurement.whiten(model.predict(knocks[half])) for knocks in halves], residual, TAPS) for half in (0, 1)]
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
    """Normal equations (C taps, C taps), (C taps,) from correlations."""
    n = scipy.fft.next_fast_len(residual.size + taps, real=True)
    spectra = [scipy.fft.rfft(c.astype(np.float64), n) for c in columns]
    target = scipy.fft.rfft(residual.astype(np.float64), n)
    right = np.concatenate([scipy.fft.irfft(np.conj(s) * target, n)[:taps] for s in spectra])
    lags = [[scipy.fft.irfft(np.conj(a) * b, n) for b in spectra] for a in spectra]
    matrix = np.block([[scipy.linalg.toeplitz(r[:taps], np.concatenate((r[:1], r[:-taps:-1]))) for r in row] for row in lags])
    return matrix, right
