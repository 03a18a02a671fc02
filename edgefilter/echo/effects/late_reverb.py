"""The robot stands in a room that reverberates more than the one it was calibrated in."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from edgefilter.dsp.convolution import convolve
from edgefilter.dsp.frames import blocks
from edgefilter.echo.effect import Effect, Experiment, Family, Parameter, Stage, first, neutral
from edgefilter.echo.evidence import Evidence
from edgefilter.echo.measurement import Measurement, Values, VoiceModel
from edgefilter.echo.wiener import convolve_from, fit_filter, fit_supported
from edgefilter.types import SAMPLE_RATE, Array, Samples

LEAD = 32
"""Taps before lag 0: what a room of other colour changes in the direct sound."""
TAPS = 12800
"""0.8 s: the decay by 60 dB of an office, by 40 dB of a hall."""
EXPECTED = 1e-3
"""Expected square of a tap before anything is known of the room, the same at all lags."""
SLOWER = 1.7
"""The squares that are expected once the room is known decay in this many times its reverberation time, so that none of
it is cut away."""
BLOCK = 320
DIRECT = 48
"""Samples up to which no reflection of a room comes: a detour of a metre. A change there is another effect's."""
EARLY, LATE_SHARE = round(0.03 * SAMPLE_RATE), 0.1
"""Samples up to which reflections are early, and the share of the added energy that comes after those where the room is
another."""
LONGER, DECAYED = 1.3, 0.01
"""By this factor the time until DECAYED of the energy is left exceeds the calibration's: 2 to 20 in rooms of 0.4 to 0.8
s, 0.9 to 1.1 where the change was another one. So far down a sweep's response is clear of its noise, as it need not be
where a reverberation time is read off."""


class LateReverb(Effect):
    """y = x + taps * x: a long filter behind the calibrated path. Its decay gives the reverberation time.

    rt60_s: from the backward-integrated energy of the whole new response (Schroeder 1965, eq. 5), the first 20 ms left
    out, above the noise.
    level_db: energy of the taps after 10 ms, re the direct path. taps: (k,) lags -LEAD to k - LEAD.
    """

    name: ClassVar[str] = "late_reverb"
    stage: ClassVar[Stage] = "path"
    family: ClassVar[Family] = "linear path"
    title: ClassVar[str] = "late reverberation"
    shown_by: ClassVar[tuple[Experiment, ...]] = ("sweep", "tail", "place")
    complexity: ClassVar[int] = 4
    flexible: ClassVar[bool] = True
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("rt60_s", "s", 0.0, 0.0, 10.0),
        Parameter("level_db", "dB", -120.0, -120.0, 40.0),
        Parameter("taps", "1", 0.0, -10.0, 10.0),
    )

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """Return x with its reverberation added."""
        taps = np.atleast_1d(np.asarray(values["taps"], float))
        return x.copy() if not taps.any() else x + convolve_from(x, taps, LEAD)

    def fit(self, measurement: Measurement, model: VoiceModel) -> Values:
        """Least squares in the whitened domain, slightly regularised.

        Neutral where nothing of it holds on other samples.

        Then once more with taps expected to decay as the room that was found does: some seconds of speech do not teach
        ten thousand.
        """
        taps, rt60 = measurement.once(fit_path, model)
        if not taps.any():
            return neutral(self)
        late = float(np.sum(taps[LEAD + SAMPLE_RATE // 100 :] ** 2))
        return {
            "rt60_s": rt60,
            "level_db": float(np.clip(10 * np.log10(late + 1e-12), -120.0, 40.0)),
            "taps": np.clip(taps, -10.0, 10.0),
        }

    def sentence(self, values: Values) -> str:
        """How long the room sounds."""
        return (
            "the recording goes on sounding after the calibrated response has died away: "
            f"a reverberation of {first(values, 'rt60_s'):.2f} s that holds from the first second to the last"
        )

    def only(self, values: Values) -> Values:
        """The direct sound as it was."""
        taps = np.atleast_1d(np.asarray(values["taps"], float)).copy()
        taps[: LEAD + DIRECT] = 0.0
        return {**values, "taps": taps}

    def plausible(self, evidence: Evidence) -> bool:
        """Whether what it adds is reverberation: a good part comes later than early reflections do, and decays more slowly than at the calibration.

        A loudspeaker of another colour or a path that moved are stationary, too, and a filter this long takes up
        either.
        """
        return rings_longer(evidence)


def fit_path(measurement: Measurement, model: VoiceModel) -> tuple[Array, float]:
    """Taps at lags -LEAD to k - LEAD behind the calibrated path, (k,), zeros where none hold on other samples; RT60 of the new path in s."""
    x = measurement.heard(model)[1]
    residual = measurement.white_recording - x
    length = min(TAPS, measurement.recording.size // 4)
    taps = fit_supported(x, residual, measurement.weights, length, LEAD, prior=np.full(length, EXPECTED), steps=40)
    if not taps.any():
        return taps, 0.0
    response = convolve(model.impulse_response.astype(np.float64), taps)[LEAD:]
    response[: model.impulse_response.size] += model.impulse_response
    direct = int(np.argmax(np.abs(model.impulse_response)))
    rt60 = reverberation_time(response[direct : taps.size - LEAD])
    rt60 = rt60 or reverberation_time(model.impulse_response[direct:].astype(np.float64))
    if rt60 > 0.0:
        prior = decaying(taps, SLOWER * rt60)
        taps = fit_filter(x, residual, measurement.weights, length, LEAD, prior=prior, steps=60)
    return taps, rt60


def rings_longer(evidence: Evidence) -> bool:
    """Whether taps make the room longer: a good part of what they add, a gain apart, comes later than early reflections do.

    And the whole decays more slowly.
    """
    taps = np.atleast_1d(np.asarray(evidence.values["taps"], float))
    direct = int(np.argmax(np.abs(evidence.model.impulse_response)))
    before = evidence.model.impulse_response[direct:].astype(np.float64)
    added = convolve(evidence.model.impulse_response.astype(np.float64), taps)[LEAD + direct :]
    after = added.copy()
    after[: before.size] += before[: added.size]
    known = np.pad(before, (0, max(added.size - before.size, 0)))[: added.size]
    added -= float(added @ known) / float(known @ known) * known
    late = float(np.sum(added[EARLY:] ** 2)) >= LATE_SHARE * float(np.sum(added**2))
    return late and decay(after) > LONGER * decay(before)


def block_energy(taps: Array) -> tuple[Array, float]:
    """Energy of the taps in blocks of 20 ms, and that of a block of pure noise (the lower quartile of the last third)."""
    energy = np.sum(blocks(taps, BLOCK) ** 2, axis=1)
    count = energy.size
    return energy, float(np.quantile(energy[2 * count // 3 :], 0.25)) if count >= 3 else 0.0


def decay(response: Array) -> int:
    """Samples until DECAYED of the energy of a response (k,) from lag 0 is left (Schroeder 1965, eq. 5)."""
    left = np.cumsum(response[::-1] ** 2)[::-1]
    return int(np.argmax(left <= DECAYED * left[0]))


def decaying(taps: Array, rt60_s: float) -> Array:
    """Expected squares of taps (k,) with the energy that these have above their noise, decaying with that reverberation time, (k,).

    The first block, which holds what another room changes in the direct sound, is expected as it was found.
    """
    energy, floor = block_energy(taps)
    blocks = np.arange(energy.size)
    total = float(np.sum(np.maximum(energy[1:] - floor, 0.0))) / float(
        np.sum(10 ** (-6.0 * blocks[1:] * BLOCK / SAMPLE_RATE / rt60_s))
    )
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
