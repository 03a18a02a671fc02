"""A player that turns down what is loud in each of three bands by itself."""

from __future__ import annotations

from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from edgefilter.dsp.frames import stretch
from edgefilter.echo.effect import Effect, Parameter, Runner, complete, neutral, numbers
from edgefilter.echo.effects.compression import STEEPEST, Compressor
from edgefilter.echo.effects.equaliser import MOST_DB
from edgefilter.echo.effects.gain_fit import GainFit, Reach
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.echo.wiener import Spectra, spectra
from edgefilter.types import SAMPLE_RATE, Array, Samples

BANDS = 3
LOW_HZ, HIGH_HZ = np.geomspace(90.0, 900.0, 14), np.geomspace(1000.0, 6000.0, 12)
"""Crossovers that are tried, so close that no band's phase is off by more than some 20 degrees."""
FINER = np.array([0.91, 0.95, 1.0, 1.05, 1.1])
"""Times the best of these, which are tried next."""
DELAYS = np.arange(-24.0, 25.0)
"""Samples: the lag at which such a recording is found is that of its loudest band."""
STARTS = tuple(product((-6.0, -15.0, -25.0), (0.5,), np.log([8.0]), np.log([150.0])))
"""Thresholds in dB re the loudest 20 ms of the reference in each band, slopes, attack and release as of `compression`, to start from."""
_EACH = np.ones(BANDS)
REACH = Reach(
    nudge=np.concatenate((0.5 * _EACH, 0.03 * _EACH, [0.15, 0.15])),
    lowest=np.concatenate((-80.0 * _EACH, 0.0 * _EACH, np.log([0.3, 5.0]))),
    highest=np.concatenate((0.0 * _EACH, STEEPEST * _EACH, np.log([200.0, 5000.0]))),
)
"""Of thresholds in dB, slopes in dB per dB, attack and release as natural logarithms of ms."""


class MultibandCompression(Effect):
    """y = sum_k C_k(h_k * x(n - delay)), C_k a compressor as of `compression`, h_1 to h_3 three bands from low to high.

    h_k: crossovers of fourth order, in phase with each other, |sum_k H_k| = 1 (Linkwitz 1976); the phase of that sum is the
    effect's, too. threshold_db, ratio, makeup_db: (3,); attack_ms, release_ms: of all. delay: in whole samples, re the lag
    at which a recording is found, which is that of its loudest band.
    """

    name = "multiband_compression"
    stage = "source"
    family = "dynamics"
    title = "multi-band compression"
    flexible = True
    parameters = (
        Parameter("crossover_hz", "Hz", 1000.0, 20.0, 7500.0),
        Parameter("threshold_db", "dB re full scale", -20.0, -80.0, 0.0),
        Parameter("ratio", "dB/dB", 1.0, 1.0, 50.0),
        Parameter("attack_ms", "ms", 10.0, 0.1, 1000.0),
        Parameter("release_ms", "ms", 200.0, 1.0, 5000.0),
        Parameter("makeup_db", "dB", 0.0, -MOST_DB, MOST_DB),
        Parameter("delay", "samples", 0.0, -100.0, 100.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Return x (n,) with each of its bands turned by its own level; where none is, x itself."""
        return BandCompressor(values, sample_rate)(_moved(x, float(values["delay"])))

    def run(self, values: Values, sample_rate: int) -> Runner:
        """The compressors, which carry their levels and their filters on; where the voice is, the aligner says."""
        return BandCompressor(values, sample_rate)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The crossovers from the spectra, then Gauss-Newton in the rest from the best of three starts.

        Neutral where the bands do not pay.
        """
        crossed = find_crossovers(spectra(measurement, model))
        if crossed is None:
            return neutral(self)
        low, high, delay = crossed
        filters = {"crossover_hz": np.array([low, high])}

        def parts(x: Samples, unknowns: Array) -> list[Samples]:
            values = complete(self, {**filters, **_values(unknowns)})
            return BandCompressor(values, SAMPLE_RATE).bands(_moved(x, delay))

        fit = GainFit(measurement, model, parts, REACH)
        found = fit.best([_start(fit.loud_db, *start) for start in STARTS])
        if found is None:
            return neutral(self)
        makeup_db = np.clip(20.0 * np.log10(np.maximum(fit.gains(found), 1e-2)), -MOST_DB, MOST_DB)
        return {**filters, **_values(found), "delay": delay, "makeup_db": makeup_db}

    def sentence(self, values: Values) -> str:
        """The compression ratio of each band, for the report."""
        low, high = numbers(values, "crossover_hz", 2)
        ratios = ", ".join(f"{ratio:.1f}" for ratio in numbers(values, "ratio", BANDS))
        return (
            f"bands below {low:.0f} Hz, up to {high:.0f} Hz and above are each turned down when they have been loud, by"
            f" {ratios} to 1"
        )


class BandCompressor:
    """One multi-band compressor on a stream: values as of MultibandCompression."""

    def __init__(self, values: Values, sample_rate: int) -> None:
        names = ("threshold_db", "ratio", "makeup_db")
        each = [numbers(values, name, BANDS) for name in names]
        shared = {"attack_ms": values["attack_ms"], "release_ms": values["release_ms"], "knee_db": 6.0}
        self._compressors = [
            Compressor({**dict(zip(names, band, strict=True)), **shared}, sample_rate)
            for band in zip(*each, strict=True)
        ]
        self._crossovers = [_Crossover(hz, sample_rate) for hz in numbers(values, "crossover_hz", 2)]
        self._idle = bool(np.all(each[1] == 1.0) and np.all(each[2] == 0.0))

    def __call__(self, x: Samples, heard: Samples | None = None) -> Samples:
        """Return x (n,), which follows what came before, each band times its gain."""
        return x.copy() if self._idle or not x.size else np.sum(self.bands(x), axis=0, dtype=np.float32)

    def bands(self, x: Samples) -> list[Samples]:
        """Three signals (n,), from low to high."""
        low, rest = self._crossovers[0](x)
        return [turn(band) for turn, band in zip(self._compressors, (low, *self._crossovers[1](rest)), strict=True)]


class _Crossover:
    """What lies below and above a frequency, on a stream: Butterworth filters of second order, twice each."""

    def __init__(self, hz: float, sample_rate: int) -> None:
        k = np.tan(np.pi * hz / sample_rate)
        poles = np.array([k * k + np.sqrt(2.0) * k + 1.0, 2.0 * k * k - 2.0, k * k - np.sqrt(2.0) * k + 1.0])
        zeros = k * k * np.array([1.0, 2.0, 1.0]), np.array([1.0, -2.0, 1.0])
        self._filters = [np.tile(np.concatenate((each, poles)) / poles[0], (2, 1)) for each in zeros]
        self._memory = [np.zeros((2, 2)), np.zeros((2, 2))]

    def __call__(self, x: Samples) -> tuple[Samples, Samples]:
        outputs = []
        for side, sos in enumerate(self._filters):
            y, self._memory[side] = scipy.signal.sosfilt(sos, x, zi=self._memory[side])
            outputs.append(y.astype(np.float32))
        return outputs[0], outputs[1]


def find_crossovers(found: Spectra) -> tuple[float, float, float] | None:
    """The two frequencies in Hz at whose crossovers' phases three turned bands explain most, and their delay in samples.

    None where the bands explain as much without these phases: then nothing was cut into bands.
    """
    turned = found.earlier(DELAYS)

    def explained(bands: NDArray[np.complex128]) -> Array:
        """Energy that the bands of each pair of crossovers (pairs, BANDS, m) explain, (pairs, delays); -inf where a gain is negative."""
        both = np.concatenate((bands.real, bands.imag), axis=2)
        matrix = both * np.tile(found.predicted, 2) @ both.swapaxes(1, 2)
        right = both @ turned
        held = 1e-9 * np.trace(matrix, axis1=1, axis2=2) + 1e-12
        gains = np.linalg.solve(matrix + held[:, None, None] * np.eye(BANDS), right)
        return np.where((gains > 0.0).all(axis=1), np.sum(gains * right, axis=1), -np.inf)

    low_hz, high_hz, most, without = LOW_HZ, HIGH_HZ, -np.inf, -np.inf
    best = 0.0, 0.0, 0.0
    for _ in range(2):
        pairs = list(product(low_hz, high_hz))
        below, above = ({hz: _halves(found.hz, hz) for hz in side} for side in (low_hz, high_hz))
        cut = ((*below[low], *above[high]) for low, high in pairs)
        bands = np.stack([(bass, rest * middle, rest * treble) for bass, rest, middle, treble in cut])
        without = max(without, float(explained(np.abs(bands).astype(complex)).max()))
        worth = explained(bands)
        if worth.max() > most:
            most = float(worth.max())
            pair, delay = divmod(int(worth.argmax()), DELAYS.size)
            best = *pairs[pair], float(DELAYS[delay])
        if not most > without:
            return None
        low_hz, high_hz = best[0] * FINER, best[1] * FINER
    return best


def _moved(x: Samples, delay: float) -> Samples:
    """Delay x (n,) by that many whole samples."""
    return stretch(x, -round(delay), x.size - round(delay))


def _halves(hz: Array, crossover_hz: float) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Frequency responses (m,) of _Crossover's lowpass and highpass, in closed form."""
    s = 1j * np.tan(np.pi * hz / SAMPLE_RATE) / np.tan(np.pi * crossover_hz / SAMPLE_RATE)
    rest = (s * s + np.sqrt(2.0) * s + 1.0) ** 2
    return 1.0 / rest, s**4 / rest


def _start(loud_db: float, below_db: float, slope: float, attack: float, release: float) -> Array:
    """Unknowns: the bands of speech are some 0, 5 and 15 dB under the whole."""
    thresholds = loud_db + below_db - np.array([0.0, 5.0, 15.0])
    return np.concatenate((thresholds, slope * _EACH, (attack, release)))


def _values(unknowns: Array) -> dict[str, float | Array]:
    attack, release = np.exp(unknowns[-2:])
    return {
        "threshold_db": unknowns[:3].copy(),
        "ratio": 1.0 / (1.0 - unknowns[3:6]),
        "attack_ms": float(np.clip(attack, 0.1, 1000.0)),
        "release_ms": float(np.clip(release, 1.0, 5000.0)),
    }
