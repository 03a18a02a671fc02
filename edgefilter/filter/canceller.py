"""The linear stage: a partitioned-block frequency-domain Kalman filter that predicts the robot's voice at the microphone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.dsp.membrane import DISPLACEMENT_TAPS, displacement_taps
from edgefilter.errors import SignalError
from edgefilter.types import SAMPLE_RATE, Samples

TRANSITION = 0.9999
"""A of the first-order Markov model of the echo path per hop of 16 ms: it forgets with a time constant of 160 s."""
WARM_DOUBT = 0.05
"""Variance of a calibrated path relative to its own power: the robot moved and the room is another."""
DECAY_RT60_S = 1.0
"""Decay of the covariance prior behind the direct sound, seconds for 60 dB."""
LATE_DOUBT = 0.04
"""Power of the unknown room's decay at the direct sound, relative to the calibrated path."""
NOISE_MEMORY = 0.8
"""Weight of the past in the measurement-noise PSD: 80 ms, so that the onset of near-end speech still stops the adaptation."""
OWN_SHARE = 0.6
"""Share of the expected misalignment that is not counted as measurement noise; 1 adapts fastest, 0 is safest in double talk."""
DISPLACEMENT_SCALE = 0.1
"""Displacement, in the reference's full scale, at which the products have the size of the reference."""
PRODUCT_PARTITIONS = 2
PRODUCT_DOUBT = 2e-3
"""Variance of the paths of the nonlinear products relative to the linear path."""
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


class CancellerOutput(NamedTuple):
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
    Beside the reference x it hears d x and d^2 x, d being the membrane's displacement (x low-passed): what force factor and
    stiffness that depend on the displacement add to a moving-coil loudspeaker (Klippel 2006, "Loudspeaker nonlinearities").
    Their paths are PRODUCT_PARTITIONS long and start at zero; nonlinear=False leaves them out.
    impulse_response (n,) float32 starts the filter; longer than taps it is cut, without it the start is cold.
    Raises SignalError where hop or taps are not positive or the impulse response is not finite.
    """

    def __init__(self, hop: int = 256, taps: int = 6400, impulse_response: Samples | None = None, nonlinear: bool = True) -> None:
        if hop < 1 or taps < 1:
            raise SignalError(f"canceller got hop={hop} and taps={taps}, expected both to be at least 1 sample")
        self.hop = hop
        self.partitions = -(-taps // hop)
        self.taps = self.partitions * hop
        self.nonlinear = nonlinear
        self._initial = np.zeros(self.taps, np.float32)
        self._warm = impulse_response is not None
        if impulse_response is not None:
            if impulse_response.ndim != 1 or not np.isfinite(impulse_response).all():
                raise SignalError("the canceller's impulse response is not a finite (n,) array: calibrate again")
            known = min(self.taps, impulse_response.size)
            self._initial[:known] = impulse_response[:known]
        self._channels = 3 if nonlinear else 1
        self._first = [0, self.partitions, self.partitions + PRODUCT_PARTITIONS][: self._channels]
        self._lowpass_reversed = (displacement_taps() / DISPLACEMENT_SCALE).astype(np.float32)[::-1].copy()
        self.reset()

    @property
    def history(self) -> int:
        """Reference samples that rewrite_reference wants, the current hop included."""
        return (max(self.partitions, PRODUCT_PARTITIONS) + 2) * self.hop

    def reset(self) -> None:
        """Back to the start: the calibrated path, or none."""
        hop, bins = self.hop, self.hop + 1
        products = PRODUCT_PARTITIONS * (self._channels - 1)
        shape = (self.partitions + products, bins)
        self._weights = np.zeros(shape, np.complex64)
        self._blocks = np.zeros((shape[0], 2 * hop), np.float32)
        self._blocks[: self.partitions, :hop] = self._initial.reshape(self.partitions, hop)
        fourier.rfft(self._blocks, out=self._weights)
        product_doubt = np.broadcast_to(PRODUCT_DOUBT * self._path_power(), (products, bins))
        self._doubt = np.concatenate((self._prior(), product_doubt)).astype(np.float32)
        self._ageing = (1.0 - TRANSITION**2) * self._doubt
        self._recent = np.zeros((self._channels, 2 * hop), np.float32)
        self._all_spectra, self._all_powers = np.zeros((2 * shape[0], bins), np.complex64), np.zeros((2 * shape[0], bins), np.float32)
        self._slide(to=shape[0])
        self._moving = np.zeros(DISPLACEMENT_TAPS - 1, np.float32)
        self._noise = np.zeros(bins, np.float32)
        self._work = np.zeros(shape, np.complex64)
        self._expected = np.zeros(shape, np.float32)
        self._padded = np.zeros(2 * hop, np.float32)
        self._hops = self._active = self._phantoms = 0
        self._fade = self.gain = 1.0
        self._correlation = 0.0, 0.0, 0.0

    def step(self, mic: Samples, reference: Samples) -> CancellerOutput:
        """Cancel one hop: mic, reference (hop,) float32, neither written to."""
        self._push(reference)
        np.multiply(self._weights, self._spectra, out=self._work)
        predicted = np.add.reduce(self._work, axis=0)
        np.multiply(self._doubt, self._powers, out=self._expected)
        misalignment = np.add.reduce(self._expected, axis=0)
        echo = fourier.irfft(predicted, 2 * self.hop)[self.hop :]
        echo = self._follow_gain(mic, echo)
        echo, error, phantom = self._without_phantom(mic, echo)
        self._padded[self.hop :] = error
        error_spectrum = fourier.rfft(self._padded)
        observed = fourier.power(error_spectrum)
        self._noise *= NOISE_MEMORY
        self._noise += (1.0 - NOISE_MEMORY) * np.maximum(observed - 0.5 * OWN_SHARE * misalignment, 0.05 * observed)
        self._hops += 1
        if reference.dot(reference) > SILENCE * self.hop and not phantom:
            self._active += 1
            self._adapt(error_spectrum, 1.0 / (misalignment + 2.0 * self._noise + 1e-12))
        return CancellerOutput(echo, error, 0.5 * misalignment)

    def _follow_gain(self, mic: Samples, echo: Samples) -> Samples:
        """The echo, and the whole path with it, rescaled where one factor explains much of the error: someone turned the volume."""
        mic_power, cross, echo_power = self._correlation
        mic_power = GAIN_MEMORY * mic_power + (1.0 - GAIN_MEMORY) * float(mic.dot(mic))
        cross = GAIN_MEMORY * cross + (1.0 - GAIN_MEMORY) * float(mic.dot(echo))
        echo_power = GAIN_MEMORY * echo_power + (1.0 - GAIN_MEMORY) * float(echo.dot(echo))
        self._correlation = mic_power, cross, echo_power
        if cross <= 0.0 or echo_power <= SILENCE * self.hop:
            return echo
        factor = cross / echo_power
        error = mic_power - 2.0 * cross + echo_power
        if error <= GAIN_EXCESS * (mic_power - cross * factor) or not 0.5 < factor < 2.0:
            return echo
        self._correlation = 0.0, 0.0, 0.0
        self._weights *= np.float32(factor)
        self.gain *= factor
        return echo * np.float32(factor)

    def _without_phantom(self, mic: Samples, echo: Samples) -> tuple[Samples, Samples, bool]:
        """Echo and error, the echo faded out while subtracting it adds more than it takes, and whether that is so."""
        error = mic - echo
        phantom = float(error.dot(error)) > PHANTOM * float(mic.dot(mic)) and self._phantoms < PHANTOM_PATIENCE
        self._phantoms = self._phantoms + 1 if phantom else max(0, self._phantoms - 1)
        before, self._fade = self._fade, 0.0 if phantom else 1.0
        if before == self._fade == 1.0:
            return echo, error, phantom
        silent = before == self._fade
        echo = np.zeros_like(echo) if silent else echo * np.linspace(before, self._fade, self.hop, dtype=np.float32)
        return echo, mic - echo, phantom

    def _push(self, reference: Samples) -> None:
        """Take the reference's next hop into the spectra and powers (partitions, bins), the newest first in each channel."""
        self._recent[:, : self.hop] = self._recent[:, self.hop :]
        self._recent[0, self.hop :] = reference
        if self.nonlinear:
            moved = self._displacement(reference)
            first = np.multiply(moved, reference, out=self._recent[1, self.hop :])
            np.multiply(moved, first, out=self._recent[2, self.hop :])
        fresh = fourier.rfft(self._recent)
        rows = len(self._doubt)
        if self._at == 0:
            self._all_spectra[rows:], self._all_powers[rows:] = self._spectra, self._powers
            self._slide(to=rows)
        self._slide(to=self._at - 1)
        for row, spectrum, power in zip(self._first, fresh, fourier.power(fresh)):
            self._spectra[row], self._powers[row] = spectrum, power

    def _slide(self, to: int) -> None:
        """Look at the rows from `to` on: one place on, all of the past is one place further down without being copied."""
        self._at, rows = to, slice(to, to + len(self._doubt))
        self._spectra, self._powers = self._all_spectra[rows], self._all_powers[rows]

    def _displacement(self, reference: Samples) -> Samples:
        """(n,) of the membrane while it plays the next n samples of the reference; carries its state on."""
        moving = np.concatenate((self._moving, reference))
        self._moving = moving[reference.size :]
        return np.correlate(moving, self._lowpass_reversed, "valid")

    def _adapt(self, error_spectrum: np.ndarray, divisor: np.ndarray) -> None:
        """Kalman correction of weights and covariance, Enzner & Vary (2006), eq. (30)-(34)."""
        work, blocks, expected = self._work, self._blocks, self._expected
        np.conjugate(self._spectra, out=work)
        work *= self._doubt
        work *= error_spectrum * divisor
        fourier.irfft(work, 2 * self.hop, out=blocks)
        blocks[:, self.hop :] = 0.0  # each partition keeps to hop taps (Shynk 1992)
        self._weights += fourier.rfft(blocks, out=work)
        expected *= (-0.5 * TRANSITION**2) * divisor
        expected += TRANSITION**2
        self._doubt *= expected
        self._doubt += self._ageing

    def _path_power(self) -> np.ndarray:
        """(bins,) |H|^2 of the path at the start, summed over partitions; 1 where nothing is known."""
        return fourier.power(self._weights[: self.partitions]).sum(axis=0) if self._warm else np.ones(self.hop + 1, np.float32)

    def _prior(self) -> np.ndarray:
        """(partitions, bins) covariance before anything was heard."""
        seconds = np.arange(self.partitions) * self.hop / SAMPLE_RATE
        decay = 10.0 ** (-6.0 * seconds / DECAY_RT60_S)[:, None] * np.ones(self.hop + 1)
        if not self._warm:
            return (decay / decay.sum(axis=0)).astype(np.float32)
        return (WARM_DOUBT * fourier.power(self._weights[: self.partitions]) + LATE_DOUBT * decay * self._path_power()).astype(np.float32)

    def impulse_response(self) -> Samples:
        """The adapted path (taps,) float32, to be written back into a profile."""
        return fourier.irfft(self._weights[: self.partitions], 2 * self.hop)[:, : self.hop].reshape(-1)

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
        channels = [past]
        if self.nonlinear:
            self._moving = np.zeros(DISPLACEMENT_TAPS - 1, np.float32)
            moved = self._displacement(past)
            channels += [moved * past, moved * moved * past]
        for first, channel in zip(self._first, channels, strict=True):
            count = PRODUCT_PARTITIONS if first else self.partitions
            hops = channel.reshape(-1, self.hop)[::-1]
            self._spectra[first : first + count] = fourier.rfft(np.concatenate((hops[1 : count + 1], hops[:count]), axis=1))
        self._powers[:] = fourier.power(self._spectra)
        self._recent[:] = [channel[-2 * self.hop :] for channel in channels]

    def stats(self) -> dict[str, float]:
        """What the stage did so far."""
        return {"hops": self._hops, "active_hops": self._active, "partitions": self.partitions, "gain_db": 20.0 * float(np.log10(self.gain))}
