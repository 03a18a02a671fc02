"""The spatial filter: one channel of an array's errors, in which the human stays and what the robot makes is taken away."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.dsp.stft import StftConfig
from edgefilter.types import SAMPLE_RATE, Array, Samples, Spectrum

LOADING = 0.03
"""Part of the microphones' mean noise power that is added to each: none is quite as calibrated. .01 to .1: .5 dB of the rest."""
NOISE_MEMORY_S = 1.2
"""Of the covariance of what is left while nobody speaks. The canceller adapts and its rest with it: 3 s and 8 s leave
.9 and 1.7 dB more in a human's first turn, .5 s as much (eight simulated office conversations, validation speakers)."""
HUMAN_MEMORY_S = 3.2
"""Of the human's covariance: one who walks is followed. 1.6 s and no end at all differ by .2 dB."""
CARRIED = 0.1
"""Weight of what was known of the human before when a turn begins: the same one may speak again, or another."""
PRIOR = 10.0
"""Hops of a human as loud as the noise that the diffuse field counts for. 3 and 30: .4 dB less, and 1 dB less of the human."""
SPACING_M = 0.05
"""Distance of the microphones by which that field is reckoned: 3 and 8 cm differ by .2 dB in arrays of 4 to 8 cm."""
KNOWN_HOPS = 75
"""Of the fan alone, 1.2 s, after which it counts as known without a calibration."""
LIKELY, UNLIKELY = 0.17, 0.08
"""Probability of speech above which a hop tells of the human, and below which of the noise: network's log-odds of 2.2 and 1.5."""
NOISE_WEIGHT = 10.0
"""Weight of what is left of the noise against what is changed of the human; over 1, so that the sum stays positive definite.
With 10 `crnn` has 53 % of the words wrong at 7.6 dB SI-SDR, with 3 58 at 8.2; the best ratio of human to noise, whatever it
changes, has 52 at 5.4, one microphone 66 at 8.1 (six simulated conversations with an echo, validation speakers, 12 turns,
three microphones; 5 points of words may be chance)."""
SOFTEST = 1e-3
"""Noise over the human, -30 dB, that there is taken to be at least: with 1e-5 and nothing but a human, three microphones
were a singular matrix in single precision; with 1e-4 they are not."""
LEFT_OUT = 1e4
"""Noise over the mean that a microphone that is left out is taken to have."""


class Gathered:
    """What a human was heard as in some hops. shape: (microphones, microphones, bins) of the covariance.

    covariance: sum of outer products, each times the square of the mask. passed: (bins,) sum of those squares, which is how
    often the noise is in it as well. hops: how many.
    """

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.covariance = np.zeros(shape, np.complex64)
        self.passed = np.zeros(shape[-1], np.float32)
        self.hops = np.float32(0.0)

    def add(self, outer: Spectrum, passed: Samples) -> None:
        """A hop's covariance through the mask, whose square is passed."""
        self.covariance += outer
        self.passed += passed
        self.hops += np.float32(1.0)

    def fade(self, keep: np.float32) -> None:
        """Let all that is gathered weigh keep times as much."""
        self.covariance *= keep
        self.passed *= keep
        self.hops *= keep


class SpatialFilter:
    """Combines the microphones of one stream, bin by bin; step once a frame, then learn from what the engine made of it.

    stft: of the frames. microphones: two or more. noise: (microphones, microphones, bins) covariance of the fan where it is
    calibrated. weights: (microphones, bins), whose conjugates are multiplied with the spectra.

    The filter is the one whose answer is nearest to the human in the first microphone, where what is left of the noise weighs
    NOISE_WEIGHT times what is changed of the human: the multichannel Wiener filter weighted by distortion (Spriet, Moonen &
    Wouters 2004), with the human's whole covariance. For a human heard from one direction only it is the minimum-variance
    distortionless response (Souden et al. 2010). In a room they are heard from everywhere, and the louder they are over the
    noise in a bin, the more of that stays as in the first microphone. The noise's covariance is followed while nobody
    speaks, with and without the robot apart, and held while somebody does. The human's is gathered with the square of the
    engine's mask (Heymann et al. 2016), less the noise that the mask lets pass; a diffuse field stands for what is not known
    of it, so that a turn begins with a filter that hears every direction. It is scaled so that what is in the first
    microphone of a human of that covariance stays as loud: what of a bin is noise is for the engine to say.
    """

    def __init__(self, stft: StftConfig, microphones: int, noise: Spectrum | None = None) -> None:
        hop_s = stft.hop / SAMPLE_RATE
        self._noise_step = np.float32(hop_s / NOISE_MEMORY_S)
        self._human_keep = np.float32(1.0 - hop_s / HUMAN_MEMORY_S)
        self._ones = np.eye(microphones, dtype=np.float32)[:, :, None]
        self._prior = np.float32(PRIOR) * diffuse_coherence(stft, microphones)
        self._known_hops = 0 if noise is None else KNOWN_HOPS
        self._shape = shape = microphones, microphones, stft.bins
        self._fan = np.zeros(shape, np.complex64) if noise is None else noise.astype(np.complex64)
        self._robot = self._fan.copy()
        self._human, self._turn = Gathered(shape), Gathered(shape)
        self._against = self._fan
        self._speaking = False
        self._without, self._reference = np.zeros((microphones, 1, 1), np.float32), 0
        self.weights = self._best(self._human, self._fan)

    def use(self, used: np.ndarray) -> None:
        """Leave out the microphones where used (microphones,) is False; the first that is used is the one to sound like."""
        self._without = np.where(used, np.float32(0.0), np.float32(LEFT_OUT))[:, None, None]
        self._reference = int(np.argmax(used))

    def step(self, spectra: Spectrum) -> Spectrum:
        """Combine the microphones of spectra (k, microphones, bins), all by the same weights, to (k, bins)."""
        return np.einsum("cf,kcf->kf", self.weights.conj(), spectra)

    def fan_psd(self) -> Samples | None:
        """Expected |spectrum|^2 of the fan in what step makes, (bins,); None where it was neither calibrated nor heard alone."""
        return None if self._known_hops < KNOWN_HOPS else _form(self.weights, self._fan)

    def independent(self, powers: Samples) -> Samples:
        """Power of what is independent from microphone to microphone, powers (microphones, bins), in what step makes; (bins,)."""
        return np.einsum("cf,cf->f", fourier.power(self.weights), powers)

    def learn(self, error: Spectrum, gain: Samples, probability: float, speaking: bool, idle: bool) -> None:
        """Take in a frame: error (microphones, bins), and what the engine made of it.

        gain: (bins,) magnitude of the engine's answer over that of the error, 0 to 1. probability: that a human speaks.
        speaking: whether a turn of the human is under way. idle: whether nothing of the robot can be audible.
        """
        outer = error[:, None] * error.conj()
        self._against = noise = self._fan if idle else self._robot
        heard = speaking or probability > LIKELY
        if heard:
            if not self._speaking:
                self._human.fade(np.float32(CARRIED))
                self._turn = Gathered(self._shape)
            self._human.fade(self._human_keep)
            if probability > LIKELY:
                passed = np.square(gain)
                outer *= passed
                self._human.add(outer, passed)
                self._turn.add(outer, passed)
        elif probability < UNLIKELY:
            noise += self._noise_step * (outer - noise)
            self._known_hops += idle
        self._speaking = heard
        self.weights = self._best(self._human, noise)

    def finished(self) -> Spectrum:
        """Weights for the latest turn of the human as a whole, (microphones, bins): all of it weighs the same."""
        return self._best(self._turn, self._against)

    def _best(self, gathered: Gathered, noise: Spectrum) -> Spectrum:
        """Weights for a human of whom that is gathered, and against noise of that covariance."""
        at, hops = self._reference, gathered.hops + np.float32(PRIOR)
        heard = np.einsum("ccf->f", gathered.covariance).real / hops
        level = np.maximum(np.einsum("ccf->f", noise).real, np.float32(SOFTEST) * heard) / len(noise) + fourier.TINY
        noise, sound = noise / level, gathered.covariance / level
        passed = np.minimum(gathered.passed, sound[at, at].real / (noise[at, at].real + fourier.TINY))
        sound += self._prior
        human = (sound - passed * noise) / hops
        loaded = noise + (np.float32(LOADING) + self._without) * self._ones
        found = solve(human + np.float32(NOISE_WEIGHT) * loaded, human[:, at])
        return found * np.sqrt(sound[at, at].real / _form(found, sound))


def diffuse_coherence(stft: StftConfig, microphones: int) -> Samples:
    """Covariance of equal microphones, every two SPACING_M apart, in a diffuse field, (microphones, microphones, bins) float32.

    Negative values are set to 0: more than five microphones cannot all be so negatively correlated with one another.
    """
    between = np.sinc(2.0 * stft.frequencies * SPACING_M / 343.0)  # m/s, the speed of sound
    ones = np.eye(microphones)[:, :, None]
    return (ones + (1.0 - ones) * np.maximum(between, 0.0)).astype(np.float32)


def solve(matrix: Spectrum, right: Spectrum) -> Spectrum:
    """The x (n, bins) of matrix x = right, in each bin; matrix: (n, n, bins), Hermitian, positive definite.

    A Cholesky factorisation without roots, matrix = L D L^H, in all bins at once: ten times as fast as bin by bin.
    """
    n = len(right)
    lower: list[list[Spectrum]] = [[] for _ in range(n)]
    pivots: list[Array] = []
    x = [right[i] for i in range(n)]
    for i in range(n):
        for j in range(i):
            left = matrix[i, j]
            for k in range(j):
                left = left - lower[i][k] * lower[j][k].conj() * pivots[k]
            lower[i].append(left / pivots[j])
            x[i] = x[i] - lower[i][j] * x[j]
        pivot = matrix[i, i].real
        for k in range(i):
            pivot = pivot - fourier.power(lower[i][k]) * pivots[k]
        pivots.append(pivot)
    for i in reversed(range(n)):
        x[i] = x[i] / pivots[i]
        for k in range(i + 1, n):
            x[i] = x[i] - lower[k][i].conj() * x[k]
    return np.stack(x)


def _form(vector: Spectrum, matrix: Spectrum) -> Samples:
    """Return vector^H matrix vector for vector (n, bins) and a Hermitian matrix (n, n, bins), (bins,)."""
    return np.einsum("cf,cf->f", vector.conj(), np.einsum("cdf,df->cf", matrix, vector)).real
