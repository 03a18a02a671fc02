"""Power spectra of the residual echo and of the stationary noise in the linear stage's error, for a mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.dsp.stft import StftConfig
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Array, Samples, Spectrum

LEAKAGE = 0.005
"""Part of the echo's power that no linear path explains, -23 dB, at first, where the profile does not know the distortion."""
BOUNDS = 0.0024, 0.1
"""Least and most of it, -26 and -10 dB, once it is tracked."""
LEAKAGE_MEMORY, STEPS = 0.97, (0.9, 1.005)
"""The part is observed over half a second of the robot's speech. In a frame it changes by these factors at most: it falls at
once and rises by 1.4 dB a second, so that a human's sentence hardly lifts it."""
MARGIN = 3.0
"""Leakage over what is tracked: a mask needs that of loud moments, which distort most, and quiet ones are tracked."""
OVER_NOISE = 60.0
"""Power of the echo over the noise's, 18 dB, from which on its leakage can be told from the noise."""
SPREAD, SPREAD_HZ = 0.1, 2000.0
"""Distortion falls on other frequencies too: this part of the echo's mean over SPREAD_HZ counts as well."""
TAIL_DECAY = 0.6
"""Fall of the residual echo per hop, room for what lies beyond the canceller's tail and between its frames."""
MISALIGNMENT_WARM, MISALIGNMENT_COLD = 0.5, 2.0
"""Weight of the canceller's estimate of its misalignment: too large for a calibrated path, too small from nothing."""
WITH_VOICE_MEMORY, WITH_VOICE_RISE, WITH_VOICE_HELD = 0.98, 1.05, 0.9
"""The noise that sounds with the robot's voice but is no echo, such as motors, is averaged over .8 s, and the estimate rises by 13 dB a
second at most, so that a human who has not been noticed yet hardly raises it. It is expected in proportion to the echo's running
peak, which falls by .5 dB a hop, since motors stop more slowly than words. Of 48 false starts beside the motors of 20 simulated
robots (11 minutes in all) 19 are left."""
WITH_VOICE_MARGIN = 2.0
"""Power of that over what is observed: a sound of motors goes up and down. With 3 one false start less is left, and a
filter that starts three seconds before a soft human notices them .15 s later."""


class NoiseTracker:
    """Power of the stationary noise in each bin, also while somebody speaks.

    Every frame is weighted by the probability that it holds only noise: Gerkmann & Hendriks (2012), "Unbiased MMSE-based
    noise power estimation with low complexity and low tracking delay", eq. (18), (22) and (23), with their values.
    """

    PRESENT = np.float32(10.0**1.5)
    """Power of speech over the noise where there is any, 15 dB."""
    STUCK = np.float32(0.99)
    """Mean probability of speech from which on the tracker counts as stuck: a noise that has grown is no speech."""
    FIRST = 5
    """Frames whose mean is the first estimate."""
    RENEWED, STUCK_RENEWED = np.float32(1.0) - np.float32(0.8), np.float32(1.0) - np.float32(0.9)
    """Share of a new frame in the noise, and in the mean probability of speech by which it is found to be stuck."""

    def __init__(self, bins: int) -> None:
        self.power = np.zeros(bins, np.float32)
        self._present = np.zeros(bins, np.float32)
        self._count, self._loudest = 0, 0.0

    def step(self, observed: Samples) -> Samples:
        """The noise's power (bins,) after a frame of the power observed (bins,)."""
        self._loudest = max(self._loudest, float(np.add.reduce(observed)) / observed.size)
        self._count += 1
        if self._count <= self.FIRST:
            self.power += (observed - self.power) / np.float32(self._count)
        else:
            likelihood = np.minimum(observed / self.power, 100.0) * (self.PRESENT / (1.0 + self.PRESENT))
            present = 1.0 / (1.0 + (1.0 + self.PRESENT) * np.exp(-likelihood))
            self._present += self.STUCK_RENEWED * (present - self._present)
            present = np.where(self._present > self.STUCK, np.minimum(present, self.STUCK), present)
            self.power += self.RENEWED * (1.0 - present) * (observed - self.power)
        np.maximum(self.power, np.float32(fourier.LEAST * self._loudest + fourier.TINY), out=self.power)
        return self.power


class Residual:
    """Tracks the stationary noise and the residual echo of one stream; step() once per frame.

    The noise is what NoiseTracker finds in the error; with a profile, the calibrated shape at that level. The leakage, the
    part of the echo that stays in its own bins, begins with the loudspeaker's distortion where the profile knows it from
    multisines, and follows the least ratio of error to echo while the robot speaks, for a human can only add to it. What else
    sounds with the voice, in any bin (motors), is followed as a part of the echo's whole power.

    nobody_speaks: whether that is known; set by who hears the answer. with_voice: (bins,), that part, as in `WhileMoving`.
    """

    def __init__(self, stft: StftConfig, profile: Profile | None = None) -> None:
        self.nobody_speaks = False
        self._bins = stft.bins
        width = max(1, round(SPREAD_HZ / stft.frequencies[1]))
        self._spread = np.full(width, SPREAD / width, np.float32)
        fan = profile.noise_bins(stft) if profile is not None else None
        self._calibrated = fan if fan is not None and fan.all() else None
        self._misalignment = np.float32(MISALIGNMENT_COLD if profile is None else MISALIGNMENT_WARM)
        known = profile.approximation if profile is not None else None
        self._leakage = LEAKAGE if known is None else _within(BOUNDS, known.share)
        self._left = self._brought = 0.0
        moving, self._loudest = profile and profile.while_moving, 0.0
        self.with_voice = moving.with_voice(stft) if moving else np.zeros(self._bins, np.float32)
        self._tracked = NoiseTracker(self._bins)
        before = self._spread.size // 2  # beyond its ends the echo counts as what it is there
        self._extended = np.zeros(self._bins + self._spread.size - 1, np.float32)
        self._below, self._echo, self._above = np.split(self._extended, (before, before + self._bins))

    def step(
        self,
        echo: Spectrum,
        error: Spectrum,
        uncertainty: Samples,
        added: Samples | None = None,
        fan: Samples | None = None,
    ) -> tuple[Samples, Samples]:
        """Expected |noise|^2 and |residual echo|^2 in error, both (bins,) float32.

        echo, error: (bins,) of the frame. uncertainty: (bins,), CancellerOutput.uncertainty of the frame's last hop.
        added: (bins,), what of the robot no waveform predicts. fan: (bins,), the noise, where somebody knows it better.
        """
        self._echo *= TAIL_DECAY
        np.maximum(fourier.power(echo), self._echo, out=self._echo)
        observed = fourier.power(error)
        noise = self._tracked.step(observed)
        if fan is not None:
            noise = fan
        elif self._calibrated is not None:
            over, middle = noise / self._calibrated, self._bins // 2
            noise = self._calibrated * np.partition(over, middle)[middle]  # the median, since bins are odd
        noise_power = float(np.add.reduce(noise))
        self._below[:], self._above[:] = self._echo[0], self._echo[-1]
        brought = np.correlate(self._extended, self._spread, "valid")
        brought += self._echo
        unknown = self._misalignment * uncertainty
        if added is not None:
            unknown += added
        loud = float(np.add.reduce(brought))
        if loud > OVER_NOISE * noise_power:
            self._track(float(np.vdot(error, error).real) - noise_power - float(np.add.reduce(unknown)), loud)
        brought *= self._leakage
        brought += unknown
        self._loudest = max(loud, WITH_VOICE_HELD * self._loudest)
        if self.nobody_speaks and self._loudest > OVER_NOISE * noise_power:
            self._follow(observed - noise - brought)
        brought += np.float32(WITH_VOICE_MARGIN * self._loudest) * np.maximum(self.with_voice, np.float32(0.0))
        return noise, brought

    def _follow(self, left: Samples) -> None:
        """Follow what else sounds when the robot talks. left: (bins,), power of the error beyond all that is expected.

        Below zero as well: the noise goes up and down, and of its excess alone a third of it would be learned.
        """
        part = left / np.float32(self._loudest)
        most = np.float32(WITH_VOICE_RISE) * np.maximum(self.with_voice, np.float32(LEAKAGE / self._bins))
        self.with_voice += np.float32(1.0 - WITH_VOICE_MEMORY) * (part - self.with_voice)
        np.minimum(self.with_voice, most, out=self.with_voice)

    def _track(self, left: float, brought: float) -> None:
        """Follow the leakage. left: error power beyond noise and unknown echo; brought: power of the echo."""
        self._left += (1.0 - LEAKAGE_MEMORY) * (left - self._left)
        self._brought += (1.0 - LEAKAGE_MEMORY) * (brought - self._brought)
        change = MARGIN * max(self._left, 0.0) / self._brought / self._leakage
        self._leakage = _within(BOUNDS, self._leakage * _within(STEPS, change))


def _within(bounds: tuple[float, float], value: float) -> float:
    return min(max(value, bounds[0]), bounds[1])


class Unpredictable:
    """Expected |spectrum|^2 of effects that no waveform predicts, from their expected squares.

    colours: (601,) spectral density of each per Hz, integral 1, 0 to 8 kHz.
    """

    def __init__(self, stft: StftConfig, colours: Sequence[Array]) -> None:
        grid_hz = np.linspace(0.0, SAMPLE_RATE / 2, len(colours[0]))
        density = [np.interp(stft.frequencies, grid_hz, colour) for colour in colours]
        self._density = (np.array(density) * SAMPLE_RATE / 2).astype(np.float32)
        self._weights = np.square(stft.analysis_window)
        self._squares = np.zeros((len(colours), stft.window_length), np.float32)

    def step(self, squares: Sequence[Samples]) -> Samples:
        """Expected power of the frame that ends with this hop, (bins,); squares: (hop,) of each effect."""
        hop = squares[0].size
        self._squares[:, :-hop] = self._squares[:, hop:]
        self._squares[:, -hop:] = squares
        return (self._squares @ self._weights) @ self._density
