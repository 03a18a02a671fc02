"""The robot stands in a room that reverberates more than the one it was calibrated in."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.convolution import filtered
from edgefilter.dsp.frames import blocks, decibels
from edgefilter.echo.effect import Effect, Parameter, first, neutral, numbers, within
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.echo.wiener import LONGEST, fit_filter, fit_supported
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

EXPECTED = 1e-3
"""Expected square of a tap before anything is known of the room, the same at all lags."""
SLOWER = 1.7
"""Times the room's reverberation time in which the expected squares decay once it is known, so that none of it is cut away."""
BLOCK = 320
"""Samples (20 ms) over which the energy of taps is summed."""
DIRECT = 48
"""Samples up to which no reflection of a room comes: a detour of a metre. A change there is another effect's."""
LATE, LOUDER_DB, LEFT = 1280, 7.5, 1e-4
"""LATE: samples, 80 ms as in the clarity C80 of ISO 3382-1, after which the energy of a response is late. LOUDER_DB: by how much its share of
all energy rises at least where a room reverberates longer: by 9 dB or more in 26 rooms to which one of three artificial
reverberators was added, by 5 at most in 16 of 17 in which robot or microphone had moved. Single echoes raise it by up to 9, but make
the centre time earlier. LEFT: share of the energy that counts as noise."""


ADDED = Parameter("added", "1", 0.0, -1e3, 1e3), Parameter("taps", "1", 0.0, -10.0, 10.0, given=True)
"""Of an effect that changes the impulse response; taps only come from profiles of earlier versions."""


class AddedResponse(Effect):
    """h + added, a flexible effect on the impulse response. added: (k,) from h's first tap on.

    taps: (k,) lags -lead to k - lead, a filter behind h, in profiles of earlier versions.
    """

    lead = 32
    stage = "response"
    family = "linear path"
    complexity = 4
    flexible = True

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        added, y = numbers(values, "added")[: x.size], x + filtered(x, numbers(values, "taps"), self.lead)
        y[: added.size] += added.astype(np.float32)
        return y


class LateReverb(AddedResponse):
    """h + added: another impulse response, that of a longer room. Its decay gives the reverberation time.

    rt60_s: from the backward-integrated energy of the whole new response (Schroeder 1965, eq. 5), the first 20 ms left
    out, above the noise. level_db: energy of what is added from 10 ms after the direct sound on, re that of h.
    """

    name = "late_reverb"
    title = "late reverberation"
    parameters = (
        Parameter("rt60_s", "s", 0.0, 0.0, 10.0),
        Parameter("level_db", "dB", -120.0, -120.0, 40.0),
        *ADDED,
    )

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """What fit_path() finds, which early_path shares; neutral where none of it holds on other samples, or the room sounds no longer."""
        added, rt60, longer = measurement.once(fit_path, model)
        if not longer:
            return neutral(self)
        late = float(np.sum(added[PRE_ROLL + SAMPLE_RATE // 100 :] ** 2) / np.sum(model.response() ** 2))
        return within(self, {"rt60_s": rt60, "level_db": 10 * np.log10(late + 1e-12), "added": added})

    def sentence(self, values: Values) -> str:
        return (
            "the recording goes on sounding after the calibrated response has died away: "
            f"a reverberation of {first(values, 'rt60_s'):.2f} s that holds from the first second to the last"
        )

    def only(self, values: Values) -> Values:
        """The direct sound as it was."""
        added = numbers(values, "added").copy()
        added[: PRE_ROLL + DIRECT] = 0.0
        return {**values, "added": added}


def fit_path(measurement: Measurement, model: VoiceModel) -> tuple[Array, float, bool]:
    """What is added to the response, (k,), zeros where none of it holds on other samples; RT60 of the new response in s; whether that is longer.

    Least squares in the whitened domain, slightly regularised, then once more with taps that are expected to decay as the
    room that was found does: some seconds of speech do not teach ten thousand.
    """
    before = model.response().astype(np.float64)
    x, residual, scale = beside(measurement, model)
    length, direct = min(LONGEST, measurement.recording.size // 4), int(np.argmax(np.abs(before)))

    def after(taps: Array) -> Array:
        """The new response from the direct sound on."""
        whole = np.pad(before, (0, max(length - before.size, 0)))
        whole[:length] += scale * taps
        return whole[direct:]

    taps = fit_supported(x, residual, measurement.weights, 0, np.full(length, EXPECTED))
    if not taps.any():
        return taps, 0.0, False
    rt60 = reverberation_time(after(taps)) or reverberation_time(before[direct:])
    if rt60 > 0.0:
        expected, noise = decaying(taps, SLOWER * rt60), block_energy(taps)[1] / BLOCK
        known = taps * expected / (expected + noise + 1e-30)  # the errors of the taps are taken to be independent
        taps = fit_filter(x, residual, measurement.weights, length, 0, expected, steps=20, start=known)
    was, now = before[direct:], after(taps)
    longer = late_db(now) > late_db(was) + LOUDER_DB and centre_time(now) > centre_time(was)
    return scale * taps, rt60, longer


def beside(measurement: Measurement, model: VoiceModel) -> tuple[Samples, Samples, float]:
    """The echo of a single tap with the energy of the response, and the residual of the model, whitened, (n,) each; that tap."""
    scale = float(np.sqrt(np.sum(np.square(model.response(), dtype=np.float64))))
    tap = measurement.predicted(model.over(np.array([scale], np.float32)))[1]
    return tap, measurement.white_recording - measurement.predicted(model)[1], scale


def block_energy(taps: Array) -> tuple[Array, float]:
    """Energy of the taps in blocks of 20 ms, and that of a block of pure noise (the lower quartile of the last third)."""
    energy = np.sum(blocks(taps, BLOCK) ** 2, axis=1)
    count = energy.size
    return energy, float(np.quantile(energy[2 * count // 3 :], 0.25)) if count >= 3 else 0.0


def centre_time(response: Array) -> float:
    """Centre of gravity in samples of the squared response (k,) from lag 0 (ISO 3382-1), the direct sound and the last LEFT left out."""
    energy = response**2
    left = np.cumsum(energy[::-1])[::-1]
    heard = (energy * (left > LEFT * left[0]))[DIRECT:]
    return float(np.average(np.arange(heard.size) + DIRECT, weights=heard)) if heard.any() else 0.0


def late_db(response: Array) -> float:
    """Share of the energy of a response (k,), whose first sample has lag 0, that comes after LATE samples, dB; at least LEFT."""
    energy = response**2
    return float(decibels(max(energy[LATE:].sum() / max(energy.sum(), 1e-30), LEFT)))


def decaying(taps: Array, rt60_s: float) -> Array:
    """Expected squares (k,): the energy that taps (k,) have above their noise, decaying in rt60_s; the first block, the direct sound's, as it is."""
    energy, floor = block_energy(taps)
    falling = 10 ** (-6.0 * np.arange(energy.size)[1:] * BLOCK / SAMPLE_RATE / rt60_s)
    total = float(np.sum(np.maximum(energy[1:] - floor, 0.0))) / float(np.sum(falling))
    expected = total / BLOCK * 10 ** (-6.0 * (np.arange(taps.size) - BLOCK / 2) / SAMPLE_RATE / rt60_s)
    expected[:BLOCK] = np.maximum(expected[:BLOCK], energy[0] / BLOCK)
    return expected


def reverberation_time(taps: Array) -> float:
    """RT60 in s of a response (k,) from lag 0; 0 where it does not decay over at least three blocks."""
    energy, floor = block_energy(taps)
    net = np.maximum(energy[1:] - floor, 0.0)
    below = np.flatnonzero(energy[1:] < 2.0 * floor)
    net = net[: int(below[0])] if below.size else net
    if net.size < 3 or net.sum() <= 0.0:
        return 0.0
    decay = 10 * np.log10(np.cumsum(net[::-1])[::-1] / net.sum() + 1e-12)
    t = np.arange(net.size) * BLOCK / SAMPLE_RATE
    used = (decay <= -2.0) & (decay >= -25.0) if (decay >= -25.0).sum() > 4 else decay >= -30.0
    used[-1] = False
    if used.sum() < 2:
        return 0.0
    slope = float(np.polyfit(t[used], decay[used], 1)[0])
    return float(np.clip(-60.0 / slope, 0.0, 10.0)) if slope < 0.0 else 0.0
