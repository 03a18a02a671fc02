"""A codec on the way to the loudspeaker: noise that follows the voice, which the reference does not hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter, uniform_filter1d

from edgefilter.dsp.fourier import power as power_of
from edgefilter.dsp.frames import decibels, frames
from edgefilter.dsp.psd import floored, hann
from edgefilter.echo.effect import Effect, Experiment, Parameter, Stage, first, neutral
from edgefilter.echo.effects.knock_power import BANDS, FRAME, HOP, band_power, colour_of_knocks
from edgefilter.echo.evidence import Evidence
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.echo.wiener import convolve_from, fit_filter
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

BAND_HZ = SAMPLE_RATE / 2 / BANDS
GRID_HZ = np.linspace(0.0, SAMPLE_RATE / 2, 601)
EMPHASIS_TAPS = 33
"""Of the filter through which the reference is as loud, band by band, as the noise."""
DECAYS_MS, EXPONENTS = (4.0, 8.0, 16.0, 32.0), (0.5, 0.7, 1.0)
"""Tried, by likelihood: a codec's frames and the room; and how the noise grows with the voice."""
NONE_DB = -100.0
TAPS, LEAD = 256, 64
"""Of the filter by which the path may differ, and a band be cut."""
SHORT, LONG = (512, 128), (1024, 256)
"""Frame and hop, for what is coherent with the voice and for its harmonics."""
PLACES = ((7, 15), (13, 7), (3, 41))
"""Frames of 8 ms and bins of 31 Hz around a cell within which a change of the voice is one complex gain: a path that moves, a
gain that changes, a clock that trembles."""
HEARD = 2.0
"""Times the fan that the residual around a cell must have to say something."""
FOLLOWS = 0.4
"""Correlation, over time in bands, of the residual's level with the voice's: what sounds by itself has none, knocks less than
0.35."""
COHERENT = 0.24
"""Of the residual's power around a cell, what one gain of the voice explains at most: chance is 0.05, codecs are up to 0.22,
distortions from 0.25 on and all that moves from 0.4 on."""
HARMONIC, PEAKED = 0.4, 1.26
"""Correlation of the residual's fine structure over frequency with the voice's, and its spread re that of noise, at most: a
loudspeaker's distortion has the voice's harmonics (of 72 pieces of a real one the least are 0.32 and 1.32), a talker his
own; nine codecs in ten are below 0.36 and 1.22."""
AROUND, OF_NOISE = 17, 1.1
"""Bins of 16 Hz over which that is smoothed, and the standard deviation of the log of a periodogram of noise around it."""
FEWEST = 2000
"""Cells of the fine structure that say something."""


class Codec(Effect):
    """Expected square of the noise at the microphone: sum(power) (d * (g * x)^2)^exponent, d a decay of unit sum.

    A codec spends its bits where the ear would hear the noise, so that this follows the voice in each band (Brandenburg
    & Bosi 1997, "Overview of MPEG audio: current and future standards for low-bit-rate audio coding"), yet has none of
    its phase: no waveform predicts it. emphasis_db (16,), in bands of 500 Hz, is the magnitude of g, by which the
    reference x is as loud in each as the noise; decay_ms and exponent: how it follows in time and level. power (16,)
    for that at 1. below_voice_db, noise re voice at the microphone, only reports. What the codec takes away of the band is a
    `bandlimit` beside it.
    """

    name: ClassVar[str] = "codec"
    stage: ClassVar[Stage] = "source"
    run_note: ClassVar[str] = (
        "the running filter follows by itself what noise the voice brings along: adding it changes nothing there"
    )
    title: ClassVar[str] = "a codec"
    shown_by: ClassVar[tuple[Experiment, ...]] = ("levels", "tone")
    complexity: ClassVar[int] = 3
    cost: ClassVar[int] = 4
    leaves_noise: ClassVar[bool] = True
    in_what_is_left: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("power", "full scale^2", 0.0, 0.0, 1e3),
        Parameter("emphasis_db", "dB", 0.0, NONE_DB, 0.0),
        Parameter("decay_ms", "ms", 8.0, 0.1, 100.0),
        Parameter("exponent", "1", 1.0, 0.1, 2.0),
        Parameter("below_voice_db", "dB", 0.0, -60.0, 200.0),
    )

    def variance(self, reference: Samples, values: Values, sample_rate: int) -> Samples:
        """What the noise adds to the expected square of each sample (n,) at the microphone, for an aligned reference (n,)."""
        envelope = _envelope(_emphasised(reference, values["emphasis_db"]), float(values["decay_ms"]), sample_rate)
        return (float(np.sum(values["power"])) * envelope ** float(values["exponent"])).astype(np.float32)

    def colour(self, values: Values) -> Array:
        """(601,) the spectral density of that, 0 to 8 kHz, per Hz: its integral is 1."""
        power = np.broadcast_to(np.asarray(values["power"], float), (BANDS,)) + 1e-30
        return (power / power.sum() / BAND_HZ)[_bands()]

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Maximum likelihood of the residual's power in cells, as for a rattle's, for each decay and exponent.

        Neutral where the fan is unknown or nothing is left over it.
        """
        if measurement.noise_psd is None:
            return neutral(self)
        predicted, target = measurement.heard(model)[1], measurement.white_recording
        left = target - predicted
        use = np.ones(target.size, bool) if measurement.fit is None else measurement.fit
        over, voice, drive = band_power(left), band_power(predicted), band_power(measurement.reference)
        loud = use[np.arange(len(over)) * HOP + FRAME // 2] & (voice.mean(axis=1) > HEARD)
        if not loud.any():
            return neutral(self)
        noise = np.maximum(over[loud].mean(axis=0) - 1.0, 1e-3) * _fan_in_bands(measurement.noise_psd)
        ratio_db = decibels(noise / np.maximum(drive[loud].mean(axis=0), 1e-12))
        emphasis_db = np.clip(ratio_db - ratio_db.max(), NONE_DB, 0.0)
        emphasised = _emphasised(measurement.reference, emphasis_db)
        best: tuple[float, float, float, Array] = (-np.inf, 8.0, 1.0, np.zeros(BANDS))
        for decay in DECAYS_MS:
            envelope = _envelope(emphasised, decay)
            for exponent in EXPONENTS:
                likelihood, power = colour_of_knocks(left, envelope**exponent, measurement.fit)
                best = max(best, (likelihood, decay, exponent, power), key=lambda entry: entry[0])
        _, decay, exponent, power = best
        below = decibels(float(np.mean(voice[loud]))) - decibels(
            float(np.mean(np.maximum(over[loud] - 1.0, 0.0))) + 1e-9
        )
        return {
            "power": np.clip(power * _fan_in_bands(measurement.noise_psd), 0.0, 1e3),
            "emphasis_db": emphasis_db,
            "decay_ms": decay,
            "exponent": exponent,
            "below_voice_db": float(np.clip(below, -60.0, 200.0)),
        }

    def sentence(self, values: Values) -> str:
        """How loud the noise is, and what it is not."""
        return (
            f"noise {first(values, 'below_voice_db'):.0f} dB below the voice follows it in every band, but neither its phase nor"
            " its harmonics: what a codec leaves, and no waveform predicts; it is shown as irreducible"
        )

    def plausible(self, evidence: Evidence) -> bool:
        """What is left follows the voice's level in each band, but not its phase, nor its harmonics."""
        signs = signs_of(evidence)
        return (
            signs.follows > FOLLOWS
            and signs.coherent < COHERENT
            and signs.harmonic < HARMONIC
            and signs.peaked < PEAKED
            and signs.cells >= FEWEST
        )


@dataclass(frozen=True)
class Signs:
    """Of a whitened residual beside the voice that a model predicts: see FOLLOWS, COHERENT, HARMONIC, PEAKED; cells: how many fine ones."""

    follows: float
    coherent: float
    harmonic: float
    peaked: float
    cells: int


def signs_of(evidence: Evidence) -> Signs:
    """What is left of the voice as predicted before the effect, a linear path of its own taken out."""
    measurement = evidence.grid.measurement
    voice = measurement.whiten(evidence.before.prediction)
    left = measurement.white_recording - voice
    taps = fit_filter(voice, left, measurement.weights, TAPS, LEAD, prior=np.full(TAPS, 1e-3), steps=15)
    fine = convolve_from(voice, taps, LEAD)
    voice, left = voice + fine, left - fine
    heard = evidence.grid.usable & (uniform_filter1d(voice * voice, LONG[0]) > HEARD)
    return Signs(_follows(voice, left, heard), _coherent(voice, left, heard), *_fine(voice, left, heard))


def _spectra(x: Samples, size: int, hop: int) -> NDArray[np.complex64]:
    window = hann(size).astype(np.float32)
    return scipy.fft.rfft(frames(x, size, hop) * (window / np.sqrt(np.sum(window**2))), axis=1)[
        :, size // 128 : -size // 128
    ]


def _whole(heard: NDArray[np.bool_], size: int, hop: int) -> NDArray[np.bool_]:
    """(frames,) whether the voice is heard in nearly all of each."""
    return frames(heard.astype(np.float32), size, hop).mean(axis=1) > 0.9


def _follows(voice: Samples, left: Samples, heard: NDArray[np.bool_]) -> float:
    """Correlation of the two levels in dB within bands over time, where both are over the fan."""
    (size, hop), edges = SHORT, np.unique(np.geomspace(1, SHORT[0] // 2 - 12, 16).astype(int))
    over, loud = (
        np.add.reduceat(uniform_filter(power_of(_spectra(x, size, hop)), (5, 1)), edges[:-1], axis=1)[:, :-1]
        / np.diff(edges)[:-1]
        for x in (left, voice)
    )
    use = _whole(heard, size, hop)[:, None] & (over > HEARD) & (loud > HEARD)
    count = np.maximum(use.sum(axis=0), 1)
    swings = []
    for level in (decibels(np.maximum(over - 1.0, 0.1)), decibels(np.maximum(loud, 0.1))):
        swings.append(use * (level - (use * level).sum(axis=0) / count))
    return _correlation(*swings)


def _coherent(voice: Samples, left: Samples, heard: NDArray[np.bool_]) -> float:
    """The most that one gain of the voice around each cell explains of the residual's power, over PLACES."""
    said, rest = (_spectra(x, *SHORT) for x in (voice, left))
    use = _whole(heard, *SHORT)[:, None]
    cross, power, over = said.conj() * rest, power_of(said), power_of(rest)
    most = 0.0
    for place in PLACES:
        along = uniform_filter(cross.real, place) ** 2 + uniform_filter(cross.imag, place) ** 2
        around = uniform_filter(over, place)
        cells = use & (around > HEARD)
        explained = along / (uniform_filter(power, place) + np.float32(1e-9))
        most = max(most, float(explained[cells].sum()) / max(float(around[cells].sum()), 1e-9))
    return most


def _fine(voice: Samples, left: Samples, heard: NDArray[np.bool_]) -> tuple[float, float, int]:
    """Signs.harmonic, peaked and cells."""
    powers = [power_of(_spectra(x, *LONG))[:, : LONG[0] * 3 // 16] for x in (voice, left)]
    logs = [np.log(power + 1e-6) for power in powers]
    fine = [log - uniform_filter1d(log, AROUND, axis=1) for log in logs]
    use = _whole(heard, *LONG)[:, None] & (uniform_filter1d(powers[1], AROUND, axis=1) > 2.0 * HEARD)
    count = int(np.count_nonzero(use))
    peaked = float(np.sqrt(np.sum(np.square(fine[1] * use)) / max(count, 1))) / OF_NOISE
    return _correlation(*(x * use for x in fine)), peaked, count


def _correlation(a: Array, b: Array) -> float:
    return float(np.sum(a * b) / np.sqrt(np.sum(a * a) * np.sum(b * b) + 1e-12))


def _emphasised(x: Samples, emphasis_db: float | Array) -> Samples:
    """X (n,) through a filter of that magnitude in bands of 500 Hz, delayed by half its taps."""
    gain_db = np.broadcast_to(np.asarray(emphasis_db, float), (BANDS,))
    centres = (np.arange(BANDS) + 0.5) * BAND_HZ
    taps = scipy.signal.firwin2(
        EMPHASIS_TAPS,
        np.concatenate(([0.0], centres, [SAMPLE_RATE / 2])),
        10.0 ** (np.concatenate((gain_db[:1], gain_db, gain_db[-1:])) / 20.0),
        fs=SAMPLE_RATE,
    )
    return scipy.signal.lfilter(taps, [1.0], x).astype(np.float32)


def _envelope(x: Samples, decay_ms: float, sample_rate: int = SAMPLE_RATE) -> Samples:
    """(n,) mean square of x (n,), decaying by 1/e in decay_ms, as late as the direct sound."""
    keep = np.exp(-1.0 / (decay_ms * 1e-3 * sample_rate))
    late = PRE_ROLL - EMPHASIS_TAPS // 2
    delayed = np.concatenate((np.zeros(late), x.astype(np.float64) ** 2))[: x.size]
    return np.maximum(scipy.signal.lfilter([1.0 - keep], [1.0, -keep], delayed), 0.0).astype(np.float32)


def _bands() -> NDArray[np.intp]:
    """(601,) the band of each frequency of a PSD."""
    return np.minimum(GRID_HZ / BAND_HZ, BANDS - 1).astype(int)


def _fan_in_bands(noise_psd: Samples) -> Array:
    """(BANDS,) power of the fan in each band, its harmonic mean: by that a whitened power is multiplied."""
    return np.bincount(_bands()) / np.bincount(_bands(), 1.0 / floored(noise_psd)) * BAND_HZ
