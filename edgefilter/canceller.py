"""The linear stage: a partitioned-block frequency-domain Kalman filter that predicts the robot's voice at the microphone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from edgefilter.echo.model import PRE_ROLL
from edgefilter.errors import SignalError
from edgefilter.types import SAMPLE_RATE, Samples

TRANSITION = 0.9998
"""A of the first-order Markov model of the echo path per hop of 16 ms: it forgets with a time constant of 80 s."""
WARM_DOUBT = 0.05
"""Variance of a calibrated path relative to its own power: the robot moved and the room is another."""
COLD_RT60_S = 1.0
"""Decay of the covariance prior behind the direct sound where nothing is known, seconds for 60 dB."""
LATE_DOUBT_DB = -14.0
"""Power of the unknown room's decay, relative to the calibrated path, at the direct sound."""
NOISE_MEMORY = 0.7
"""Weight of the past in the measurement-noise PSD; small, so that the onset of near-end speech stops the adaptation."""
GAIN_MEMORY = 0.8
"""Weight of the past in the correlation of microphone and echo that tells a turned volume; about 80 ms."""
GAIN_EXCESS = 1.5
"""A volume was turned where one common factor on the echo lowers the error's power by more than this."""
PHANTOM = 1.5
"""Error power over microphone power above which the echo that is being subtracted is not there (yet): the utterance has another lag."""
PHANTOM_PATIENCE = 120
"""Hops for which such a stretch is put down to the lag; then the path itself must have changed, and adapting goes on."""
SILENCE = 1e-10
"""Mean reference power, full scale^2, below which the path is neither adapted nor allowed to age."""


@dataclass(frozen=True, slots=True)
class CancellerOutput:
    """One hop of the linear stage.

    echo, error: (hop,) float32 with error = mic - echo exactly. uncertainty: (hop + 1,) float32, what the filter itself expects
    of |error spectrum|^2 from its misalignment, for a rectangular frame of hop samples, on frequencies 0 to Nyquist.
    """

    echo: Samples
    error: Samples
    uncertainty: Samples


class Canceller:
    """Predicts the echo of one hop from that hop's reference and corrects itself by what the prediction left.

    Overlap-save blocks of 2 * hop; partition p covers taps p * hop ... (p + 1) * hop - 1. Diagonal state-space model of Enzner &
    Vary (2006), "Frequency-domain adaptive Kalman filter for acoustic echo control", eq. (27)-(34), partitioned as in Kuech,
    Mabande & Enzner (2014), "State-space architecture of the partitioned-block-based acoustic echo controller".
    impulse_response (n,) float32 starts the filter; longer than taps it is cut, without it the start is cold.
    Raises SignalError where hop or taps are not positive or the impulse response is not finite.
    """

    def __init__(self, hop: int = 256, taps: int = 6400, impulse_response: Samples | None = None, pre_roll: int = PRE_ROLL) -> None:
        if hop < 1 or taps < 1:
            raise SignalError(f"canceller got hop={hop} and taps={taps}, expected both to be at least 1 sample")
        self.hop = hop
        self.partitions = -(-taps // hop)
        self.taps = self.partitions * hop
        self.pre_roll = pre_roll
        self._initial = np.zeros(self.taps, np.float32)
        self._warm = impulse_response is not None
        if impulse_response is not None:
            if impulse_response.ndim != 1 or not np.isfinite(impulse_response).all():
                raise SignalError("the canceller's impulse response is not a finite (n,) array: calibrate again")
            known = min(self.taps, impulse_response.size)
            self._initial[:known] = impulse_response[:known]
        self.reset()

    @property
    def history(self) -> int:
        """Reference samples that rewrite_reference wants, the current hop included."""
        return (self.partitions + 2) * self.hop

    def reset(self) -> None:
        """Back to the start: the calibrated path, or none."""
        bins = self.hop + 1
        shape = (self.partitions, bins)
        self._weights = fft.rfft(self._initial.reshape(self.partitions, self.hop), 2 * self.hop).astype(np.complex64)
        self._doubt = self._prior()
        self._ageing = (1.0 - TRANSITION**2) * self._doubt
        self._recent = np.zeros(2 * self.hop, np.float32)
        self._spectra = np.zeros((2 * self.partitions, bins), np.complex64)
        self._powers = np.zeros((2 * self.partitions, bins), np.float32)
        self._newest = 0
        self._noise = np.zeros(bins, np.float32)
        self._work = np.zeros(shape, np.complex64)
        self._gain_times_power = np.zeros(shape, np.float32)
        self._padded = np.zeros(2 * self.hop, np.float32)
        self._hops = 0
        self._phantoms = 0
        self._fade = 1.0
        self._correlation = np.zeros(3)
        self.gain = 1.0
        self._active = 0

    def step(self, mic: Samples, reference: Samples) -> CancellerOutput:
        """Cancel one hop: mic, reference (hop,) float32, neither written to."""
        spectra, powers = self._push(reference)
        np.multiply(self._weights, spectra, out=self._work)
        echo = fft.irfft(self._work.sum(axis=0))[self.hop :].astype(np.float32, copy=False)
        echo = self._follow_gain(mic, echo)
        echo, phantom = self._without_phantom(mic, echo)
        error = mic - echo
        np.multiply(self._doubt, powers, out=self._gain_times_power)
        misalignment = self._gain_times_power.sum(axis=0)
        self._padded[self.hop :] = error
        error_spectrum = fft.rfft(self._padded)
        error_power = error_spectrum.real**2 + error_spectrum.imag**2
        self._noise *= NOISE_MEMORY
        self._noise += (1.0 - NOISE_MEMORY) * error_power
        self._hops += 1
        if np.dot(reference, reference) > SILENCE * self.hop and not phantom:
            self._active += 1
            self._adapt(spectra, error_spectrum, misalignment)
        return CancellerOutput(echo, error, 0.5 * misalignment)

    def _follow_gain(self, mic: Samples, echo: Samples) -> Samples:
        """The echo, and the whole path with it, rescaled where one factor explains much of the error: someone turned the volume."""
        found = np.array((np.dot(mic, mic), np.dot(mic, echo), np.dot(echo, echo)), float)
        self._correlation = GAIN_MEMORY * self._correlation + (1.0 - GAIN_MEMORY) * found
        mic_power, cross, echo_power = self._correlation
        if cross <= 0.0 or echo_power <= SILENCE * self.hop:
            return echo
        factor = cross / echo_power
        error = mic_power - 2.0 * cross + echo_power
        if error <= GAIN_EXCESS * (mic_power - cross * factor) or not 0.5 < factor < 2.0:
            return echo
        self._correlation[:] = 0.0
        self._weights *= np.float32(factor)
        self.gain *= factor
        return echo * np.float32(factor)

    def _without_phantom(self, mic: Samples, echo: Samples) -> tuple[Samples, bool]:
        """The echo, faded out while subtracting it adds more than it takes, and whether that is so."""
        error = mic - echo
        phantom = float(np.dot(error, error)) > PHANTOM * float(np.dot(mic, mic)) and self._phantoms < PHANTOM_PATIENCE
        self._phantoms = self._phantoms + 1 if phantom else max(0, self._phantoms - 1)
        gain = 0.0 if phantom else 1.0
        if gain != self._fade:
            echo = echo * np.linspace(self._fade, gain, self.hop, dtype=np.float32)
        elif phantom:
            echo = np.zeros_like(echo)
        self._fade = gain
        return echo, phantom

    def _push(self, reference: Samples) -> tuple[np.ndarray, np.ndarray]:
        """Spectra and powers (partitions, bins) of the last reference blocks, the newest first, as views."""
        self._recent[: self.hop] = self._recent[self.hop :]
        self._recent[self.hop :] = reference
        spectrum = fft.rfft(self._recent)
        self._newest = (self._newest - 1) % self.partitions
        at, last = self._newest, self._newest + self.partitions
        self._spectra[at] = self._spectra[last] = spectrum
        self._powers[at] = self._powers[last] = spectrum.real**2 + spectrum.imag**2
        return self._spectra[at:last], self._powers[at:last]

    def _adapt(self, spectra: np.ndarray, error_spectrum: np.ndarray, misalignment: np.ndarray) -> None:
        """Kalman correction of weights and covariance, Enzner & Vary (2006), eq. (30)-(34)."""
        divisor = 1.0 / (misalignment + 2.0 * self._noise + 1e-12)
        np.conjugate(spectra, out=self._work)
        self._work *= self._doubt
        self._work *= error_spectrum * divisor
        self._constrain(self._work)
        self._weights += self._work
        self._gain_times_power *= -0.5 * divisor
        self._gain_times_power += 1.0
        self._doubt *= self._gain_times_power
        self._doubt *= TRANSITION**2
        self._doubt += self._ageing

    def _constrain(self, update: np.ndarray) -> None:
        """Keep each partition's update to hop taps (Shynk 1992)."""
        taps = fft.irfft(update, axis=1)
        update[:] = fft.rfft(taps[:, : self.hop], 2 * self.hop, axis=1)

    def _decay(self) -> np.ndarray:
        """(partitions,) power of a room's decay behind the direct sound, 1 in the first partition."""
        seconds = np.arange(self.partitions) * self.hop / SAMPLE_RATE
        return 10.0 ** (-6.0 * seconds / COLD_RT60_S)

    def _prior(self) -> np.ndarray:
        """(partitions, bins) covariance before anything was heard."""
        decay = self._decay()[:, None]
        if not self._warm:
            return np.broadcast_to(decay / decay.sum(), (self.partitions, self.hop + 1)).astype(np.float32)
        power = np.abs(fft.rfft(self._initial.reshape(self.partitions, self.hop), 2 * self.hop)) ** 2
        total = power.sum(axis=0)
        return (WARM_DOUBT * power + 10.0 ** (LATE_DOUBT_DB / 10.0) * decay * total).astype(np.float32)

    def impulse_response(self) -> Samples:
        """The adapted path (taps,) float32, to be written back into a profile."""
        return fft.irfft(self._weights, axis=1)[:, : self.hop].reshape(-1).astype(np.float32)

    def rewrite_reference(self, history: Samples) -> None:
        """Replace the past of the reference after a realignment.

        history: (n,) float32, the last n reference samples under the new delay, the hop that is about to be stepped included; what
        is missing of `self.history` samples counts as silence.
        """
        wanted = self.history
        known = np.zeros(wanted, np.float32)
        count = min(wanted, history.size)
        if count:
            known[wanted - count :] = history[history.size - count :]
        past = known[: wanted - self.hop]
        blocks = np.lib.stride_tricks.sliding_window_view(past, 2 * self.hop)[:: self.hop][::-1]
        spectra = fft.rfft(blocks, axis=1)[: self.partitions]
        self._spectra[: self.partitions] = self._spectra[self.partitions :] = spectra
        self._powers[:] = self._spectra.real**2 + self._spectra.imag**2
        self._newest = 0
        self._recent[:] = past[-2 * self.hop :]

    def stats(self) -> dict[str, float]:
        """What the stage did so far."""
        return {"hops": self._hops, "active_hops": self._active, "partitions": self.partitions, "gain_db": 20.0 * float(np.log10(self.gain))}
