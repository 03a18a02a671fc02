"""A codec or a converter passes nothing above its cut-off."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import uniform_filter1d

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.fourier import power
from edgefilter.dsp.frames import decibels
from edgefilter.dsp.psd import frequencies
from edgefilter.echo.effect import Effect, Parameter, complete, first, neutral, numbers
from edgefilter.echo.effects.knock_power import BAND_HZ, BANDS, band_power, frames_to_fit
from edgefilter.echo.measurement import Measurement, Values, VoiceModel, level_ratio
from edgefilter.echo.wiener import DELAYS, Spectra, fit_filter, spectra
from edgefilter.types import SAMPLE_RATE, Array, Samples

Filter: TypeAlias = tuple[float, float, float]
"""Cut-off in Hz, order, phase."""
GRID: tuple[Filter, ...] = tuple(
    product(np.geomspace(200.0, 7800.0, 60).tolist(), (1.0, 2.0, 4.0, 8.0, 16.0, 40.0), (0.0, 1.0))
)
"""Filters from the best of which the search goes on."""
FFT = 1024
TAPS, LEAD = 192, 64
HIGHEST_HZ = 7700.0
"""Above it, too near the end of all bands, no cut-off can be seen."""
LEAST_ORDER, BY_LAW = 2.0, 0.77
"""Orders of band limits are 2.3 or more, those of treble shelves that look like one 1.0 to 1.6; and the low-pass without its taps
does .81 to .99 of what both do, of .73 at most where another equaliser looks like one (10 band limits, 8 equalisers)."""
PASSED_HZ, FLAT_DB = 300.0, 0.3
"""From so many Hz to well below the cut-off the gain may have this standard deviation, dB, to be taken as one gain without taps."""
LOUD, NOT_CUT = 3.0, 0.05
"""Cells count above a cut-off where the voice was due by this factor over the fan, and this part of it
is still there in the median one: 0.00 behind 15 band limits, rattles beside them or not, 0.1 to 0.4 behind 8 codecs."""
STEEP = 16.0
"""Order of a cut that shows in the power alone."""
GONE = 0.25
"""Largest share of the predicted power above a cut-off that the recording may hold, where its power alone, not its waveform, shows the low-pass."""
SMOOTH = 32
"""Frames of a cell, 128 ms."""
SURE = 4.0
"""And what is missing is so many standard deviations: by chance at one edge in thirty thousand."""
PASSED = (0.8, 1.2)
"""Ratio of heard to predicted power well below the edge, between which the band was cut; beyond, the volume was changed."""


class Bandlimit(Effect):
    """Low-pass with the magnitude of a Butterworth filter, |G|^2 = 1 / (1 + (f / cutoff_hz)^(2 order)).

    phase: 0 for a linear-phase filter (resamplers, codecs), 1 for a minimum-phase one (analogue), the delay at low
    frequencies taken out; delay: what of it a lag found without the filter does not take up. taps: (k,) lags -LEAD to k
    - LEAD, by which the real filter differs from that one.
    """

    name = "bandlimit"
    stage = "path"
    family = "linear path"
    title = "a band limit"
    complexity = 1
    flexible = True
    parameters = (
        Parameter("cutoff_hz", "Hz", 16000.0, 200.0, 16000.0),
        Parameter("order", "1", 8.0, 1.0, 60.0),
        Parameter("phase", "1", 0.0, 0.0, 1.0),
        Parameter("delay", "samples", 0.0, -100.0, 100.0),
        Parameter("taps", "1", 0.0, -10.0, 10.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Return x without what lies above the cut-off; a cut-off of 16 kHz is none."""
        if float(values["cutoff_hz"]) >= 16000.0:
            return x.copy()
        hz = np.arange(FFT // 2 + 1) * sample_rate / FFT
        response = low_pass(hz, float(values["cutoff_hz"]), float(values["order"]), float(values["phase"]))
        response = response * np.exp(-2j * np.pi * hz / sample_rate * float(values["delay"]))
        y = filtered(x, fft.fftshift(fft.irfft(response, FFT)), FFT // 2)
        return y + filtered(x, numbers(values, "taps"), LEAD)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """The best of a grid of cut-offs, orders and phases, refined, each at its best delay and gain, in the whitened cross-spectrum. Then taps.

        Where more is heard above, what is common with the reference is hidden by something else, such as a codec's noise:
        then the cut-off is where the power ends. Neutral where it is no low-pass but a colouring: not steep, by its
        taps rather than by its law, or with something above it that no filter passes.
        """
        predicted, x = measurement.predicted(model)
        found = spectra(measurement, model)
        turned = found.earlier(DELAYS)

        def best_of(filters: Sequence[Filter], responses: NDArray[np.complex128]) -> tuple[Filter, float]:
            """The filter, and its delay, that makes the squared error least, at whichever gain."""
            along = np.concatenate((responses.real, responses.imag), axis=1) @ turned
            explained = np.maximum(along, 0.0) ** 2 / np.maximum(power(responses) @ found.predicted, 1e-12)[:, None]
            at, late = divmod(int(np.argmax(explained)), DELAYS.size)
            return filters[at], float(DELAYS[late])

        best, late = best_of(GRID, _on_grid(found.hz.tobytes()))
        step = 1.03
        for _ in range(5):
            near = list(
                product(
                    (best[0] / step, best[0], best[0] * step),
                    np.clip((best[1] / step**3, best[1], best[1] * step**3), 1.0, 60.0).tolist(),
                    (0.0, 0.5, 1.0),
                )
            )
            best, late = best_of(near, np.stack([low_pass(found.hz, *values) for values in near]))
            step = 1.0 + (step - 1.0) * 0.6
        like_one = best[0] < HIGHEST_HZ and best[1] >= LEAST_ORDER
        noisy = bool(model.unpredictable(measurement.reference))  # what is heard above an edge may be that noise
        edge = None if noisy else band_edge(found)
        if not like_one and edge is None:
            return neutral(self)
        values: Values = {"cutoff_hz": best[0], "order": best[1], "phase": best[2], "delay": late}
        heard, plain = measurement.white_recording, self.apply(x, {**values, "taps": 0.0}, SAMPLE_RATE)
        taps = short_filter(x, heard - plain, measurement.weights)
        passed = plain + filtered(x, taps, LEAD)
        values = {**values, "taps": np.clip(taps, -10.0, 10.0)}
        if not noisy and not _dull_above(best[0], measurement, x, passed):
            if edge is None:
                return neutral(self)
            values = complete(self, {"cutoff_hz": edge, "order": STEEP})
            dull = edge < HIGHEST_HZ and _dull_above(edge, measurement, x, self.apply(x, values, SAMPLE_RATE))
            return values if dull else neutral(self)
        gain = np.float32(level_ratio(heard, plain * measurement.weights))
        before, by_law, whole = (_level_db(measurement, heard - voice) for voice in (x, gain * plain, passed))
        return values if like_one and before - by_law > BY_LAW * (before - whole) else neutral(self)

    def sentence(self, values: Values) -> str:
        """From where on there is nothing."""
        return (
            f"what the recording has in common with the reference falls off above {first(values, 'cutoff_hz'):.0f} Hz"
        )

    def only(self, values: Values) -> Values:
        """The band that is passed as it was, where one gain is all that happens to it."""
        impulse = np.zeros(2 * FFT, np.float32)
        impulse[FFT] = 1.0
        hz = frequencies(FFT + 1)
        gain_db = 20.0 * np.log10(np.abs(fft.rfft(self.apply(impulse, values, SAMPLE_RATE))) + 1e-6)
        passed = gain_db[(hz > PASSED_HZ) & (hz < 0.6 * float(values["cutoff_hz"]))]
        if not passed.size or float(np.std(passed)) > FLAT_DB:
            return values
        taps, gain = numbers(values, "taps", TAPS), 10 ** (float(np.median(passed)) / 20)
        plain = np.zeros(TAPS, np.float32)
        plain[LEAD] = 1.0
        plain = self.apply(plain, {**values, "taps": 0.0}, SAMPLE_RATE)
        return {**values, "taps": (taps + plain) / gain - plain}


def short_filter(x: Samples, target: Samples, weights: Samples) -> Array:
    """The filter of x (n,), whitened, that explains most of a target (n,), each tap expected to be small, (TAPS,)."""
    return fit_filter(x, target, weights, TAPS, LEAD, prior=np.full(TAPS, 1e-3), steps=15)


def band_edge(found: Spectra) -> float | None:
    """Frequency in Hz above which the predicted voice is missing from the recording's power; None where it is all there.

    The power over the fan's, summed over all frequencies above an edge, is held against the predicted one. The edge is where
    more is there than half of the prediction on one side, and less on the other.
    """
    there, due = (np.cumsum(x[::-1])[::-1] for x in (found.heard - found.fan, found.predicted))
    variance = (found.fan + found.predicted) ** 2 / found.averaged
    error = np.sqrt(np.cumsum(variance[::-1])[::-1])
    at = int(np.argmax(due - 2.0 * there))
    edge = float(found.hz[at])
    below = (found.hz >= 0.25 * edge) & (found.hz <= 0.7 * edge)
    passed = float(np.sum(found.heard[below] - found.fan)) / max(float(np.sum(found.predicted[below])), 1e-12)
    missing = there[at] < GONE * due[at] and due[at] - there[at] > SURE * error[at]
    return edge if missing and PASSED[0] <= passed <= PASSED[1] else None


def _level_db(measurement: Measurement, residual: Samples) -> float:
    """Mean level of a whitened residual (n,) in cells of time and frequency, over the samples to fit on: many count, not the loudest."""
    cells = uniform_filter1d(band_power(residual), SMOOTH, axis=0)
    return float(np.mean(decibels(0.5 + 0.5 * cells[frames_to_fit(measurement.fit, len(cells))])))


def _dull_above(cutoff_hz: float, measurement: Measurement, voice: Samples, passed: Samples) -> bool:
    """Whether the recording above the cut-off holds only the low-passed voice: a codec would add its noise there.

    voice, passed: the voice before and behind the low-pass, whitened, (n,). The median over time-frequency cells, since few hold knocks.
    """
    above = np.arange(BANDS) * BAND_HZ > 1.1 * cutoff_hz
    heard, due, kept = (
        uniform_filter1d(band_power(x)[:, above], SMOOTH, axis=0) for x in (measurement.white_recording, voice, passed)
    )
    loud = (due > LOUD) & frames_to_fit(measurement.fit, len(due))[:, None]
    return bool(not loud.any() or np.median(((heard - 1.0 - kept) / np.maximum(due, LOUD))[loud]) < NOT_CUT)


@lru_cache(maxsize=2)
def _on_grid(hz: bytes) -> NDArray[np.complex128]:
    """(filters, m) responses of GRID at frequencies (m,) float64."""
    return np.stack([low_pass(np.frombuffer(hz), *values) for values in GRID])


def low_pass(hz: Array, cutoff: float, order: float, phase: float) -> NDArray[np.complex128]:
    """Complex response, (m,); the phase is that of a Butterworth filter less its delay at low frequencies, times `phase`."""
    ratio = hz / cutoff
    magnitude = 1.0 / np.sqrt(1.0 + ratio ** (2.0 * order))
    if phase == 0.0:
        return magnitude.astype(complex)
    poles = np.exp(1j * np.pi * (0.5 + (2 * np.arange(round(order)) + 1) / (2 * round(order))))
    angle = -np.sum(np.angle(1j * ratio[:, None] - poles), axis=1) + np.sum(np.angle(-poles))
    delay = -np.sum((1.0 / poles).real)
    return magnitude * np.exp(1j * phase * (angle + delay * ratio))
