"""The linear stage: a partitioned-block frequency-domain Kalman filter that predicts the robot's voice at the microphone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from edgefilter.alignment.utterances import LAST_BIT, Sustained
from edgefilter.dsp import fourier
from edgefilter.dsp.membrane import DISPLACEMENT_TAPS, displacement_taps
from edgefilter.dsp.shelf import Shelf, ShelfState
from edgefilter.errors import SignalError
from edgefilter.filter.volume import EchoLimiter, Volume
from edgefilter.types import LOUDEST, SAMPLE_RATE, CancellerStats, Samples, Spectrum

SHELF_HZ = 300.0, 450.0
"""Corners of the low shelf through which the filter hears, 7 dB deep: a block without a window spreads hum over all bins. What
is lowered is learned more slowly: without a profile the demonstration's robot is 5 dB louder below 200 Hz with 24 dB and
1 dB with 7; of 17 real devices 12 dB cost one 2.4 dB of the robot, 7 dB 0.8."""
PRIOR_VARIANCE = 0.05
"""Variance of a calibrated path relative to its own power: the robot moved and the room is another."""
UNKNOWN_VARIANCE = 0.1
"""Variance of an unknown path, summed over its partitions, relative to the power of microphone over reference in each bin
when it is first adapted: on 63 simulated and real recordings without a profile .1 and .3 leave the same within 0.2 dB, .03
learns too slowly by up to 10 dB, 1 and more forgets within hops."""
BOOST = 100.0
"""Most by which an unknown path is expected to pass one frequency better than it passes the pre-emphasised voice as a whole,
20 dB. More than that was not played: hum, rumble. Of a hum as loud as the robot 7 of 11 dB of harm are left. With 30 to
1000 each of 22 real recordings, tuned on, keeps within 1 dB of the robot; at 1000 hum does twice the harm."""
UNKNOWN_HOPS = 32
"""Hops of robot, half a second, for which an unknown path stays as uncertain as what is heard makes it: what the first
hop says, before the echo has arrived or while the voice only begins, may be wrong by any factor."""
DECAY_RT60_S = 1.0
"""Decay of the covariance prior behind the direct sound, seconds for 60 dB."""
LATE_VARIANCE = 0.04
"""Prior variance of the taps of an unknown room's reverberation, extrapolated back to the direct sound, over the calibrated path's power."""
DISPLACEMENT_SCALE = 0.7
"""Displacement, relative to the loudest rms that the reference has held so far, at which the products have its size."""
FURTHEST = 10.0
"""Largest displacement, of that size: a voice stays below 5, what begins or clicks before its level is known goes far beyond."""
PRODUCT_PARTITIONS, PRODUCT_VARIANCE = 2, 2e-3
"""Length of the paths of the nonlinear products, and their variance relative to the linear path."""
VOLUME_REOPENS = 0.02
"""Added to the variance of a path when its volume is found to be turned, relative to its power: the factor is not exact."""
REOPEN = 0.3
"""Variance, relative to its power, of a path that is found to be another one. The weights are shrunk to the echo that
is heard first: otherwise weights and variance raise each other and diverge."""
AGED_ROWS = 4
"""Partitions whose process noise is worked out anew in a hop, in turn: a path's power changes slowly."""


@dataclass(frozen=True)
class Adaptation:
    """How the Kalman filter believes that the path moves and how its error is read.

    transition: A of the first-order Markov model of the path per hop of 16 ms. noise_memory: weight of the past in the
    measurement-noise PSD. certainty: share of the gain by which a correction lowers the covariance, in theory 1/2.
    products: whether d x and d^2 x are heard beside the reference. posterior: whether the error comes after the correction.
    """

    transition: float
    noise_memory: float
    certainty: float
    products: bool
    posterior: bool


COLD = Adaptation(transition=0.9999, noise_memory=0.95, certainty=0.25, products=False, posterior=True)
"""Without a calibrated path."""
WARM = Adaptation(transition=0.99997, noise_memory=0.9, certainty=0.5, products=True, posterior=False)
"""From a calibrated path."""
LEARNED = replace(COLD, products=True)
"""From a path that speech has taught, in an earlier run or as a recording, and for one that is learned beside the filter."""


class CancellerOutput(NamedTuple):
    """One hop of the linear stage.

    echo, error: (hop,) float32 with error = mic - echo exactly. uncertainty: (hop + 1,) float32, |error spectrum|^2 that the
    filter expects from its misalignment, in a rectangular frame of hop samples, 0 to Nyquist. innovation: (hop,), the error
    of the prediction that knew nothing of this hop of the microphone. Of an array each has a leading axis of microphones.
    """

    echo: Samples
    error: Samples
    uncertainty: Samples
    innovation: Samples


@dataclass(slots=True)
class ShelfStates:
    """States of the shelves that the microphone, the path's echo, what the microphone makes of it, and the answer pass."""

    heard: ShelfState | float = 0.0
    path: ShelfState | float = 0.0
    behind: ShelfState | float = 0.0
    echo: ShelfState | float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CancellerState:
    """What a canceller knows of the path: weights (rows, bins), their covariance and the noise (bins,) that it measured.

    Of an array each has a leading axis of microphones. volume_gain: by how much the volume was turned since the path was
    measured. loudest: mean square that the reference has held at its loudest, by which the nonlinear products are scaled.
    shelves: what is under way in them.
    """

    taps: int
    adaptation: Adaptation
    weights: Spectrum
    covariance: Samples
    noise: Samples
    volume_gain: float
    loudest: float
    shelves: ShelfStates


class Canceller:
    """Predicts the echo of one hop from that hop's reference and corrects itself by what the prediction left.

    Overlap-save blocks of 2 * hop; partition p covers taps p * hop ... (p + 1) * hop - 1. Microphone and reference are
    heard through a low shelf (SHELF_HZ), which is undone in the echo. Diagonal state-space model of
    Enzner & Vary (2006), "Frequency-domain adaptive Kalman filter for acoustic echo control", eq. (27)-(34),
    partitioned as in Kuech, Mabande & Enzner (2014), "State-space architecture of the partitioned-block-based acoustic
    echo controller". Its inputs are the reference x and the products d x and d^2 x, d being the membrane's displacement (x
    low-passed): force factor and stiffness of a moving-coil loudspeaker depend on the displacement (Klippel 2006,
    "Loudspeaker nonlinearities"). Their paths are PRODUCT_PARTITIONS long and start at zero.

    impulse_response: (n,) float32 to start from, cut to taps. adaptation: WARM where that is given, COLD where not, unless
    said otherwise. microphones: of an array, None for a single one: signals are then (microphones, hop), the impulse response
    (microphones, n), and each microphone has its own path; the volume, and whether there is an echo, is decided in one of
    them (tell_by). behind(echo, mic) (hop,): the microphone's own processing of the echo; None where it has none. Raises
    SignalError where hop or taps are not positive or the impulse response is not finite.
    """

    def __init__(
        self,
        hop: int = 256,
        taps: int = 6400,
        impulse_response: Samples | None = None,
        adaptation: Adaptation | None = None,
        microphones: int | None = None,
    ) -> None:
        if hop < 1 or taps < 1:
            raise SignalError(f"canceller got hop={hop} and taps={taps}, expected both to be at least 1 sample")
        self.hop = hop
        self.behind: Callable[[Samples, Samples], Samples] | None = None
        self.partitions = -(-taps // hop)
        self.taps = self.partitions * hop
        self.adaptation = adaptation or (COLD if impulse_response is None else WARM)
        self.microphones, self._teller = microphones, 0
        self._lead = () if microphones is None else (microphones,)
        self._initial, self._initial_gain = np.zeros((*self._lead, self.taps), np.float32), 1.0
        if impulse_response is not None:
            if impulse_response.shape[:-1] != self._lead or not np.isfinite(impulse_response).all():
                raise SignalError("the canceller's impulse response is not a finite (n,) array: calibrate again")
            known = min(self.taps, impulse_response.shape[-1])
            self._initial[..., :known] = impulse_response[..., :known]
        self._channels = 3 if self.adaptation.products else 1
        self._rows = self.partitions + PRODUCT_PARTITIONS * (self._channels - 1)
        self._first = [0, self.partitions, self.partitions + PRODUCT_PARTITIONS][: self._channels]
        self._lowered, self._raised = Shelf(hop, *SHELF_HZ), Shelf(hop, *SHELF_HZ[::-1])
        self._lowpass_reversed = (displacement_taps() / DISPLACEMENT_SCALE).astype(np.float32)[::-1].copy()
        self._diverged = 0
        self.reset()

    @property
    def history(self) -> int:
        """Reference samples that rewrite_reference wants."""
        return (max(self.partitions, PRODUCT_PARTITIONS) + 1) * self.hop

    def reset(self) -> None:
        """Back to the start: the calibrated path, or none, and nothing heard."""
        rows, bins = self._rows, self.hop + 1
        self._recent = np.zeros((self._channels, 2 * self.hop), np.float32)
        self._played = np.zeros((self._channels, self.hop), np.float32)
        self._played_state = np.zeros((self._channels, 1), np.complex128)
        self._all_spectra = np.zeros((2 * rows, bins), np.complex64)
        self._all_powers = np.zeros((2 * rows, bins), np.float32)
        self._moving = np.zeros(DISPLACEMENT_TAPS - 1, np.float32)
        self._loudest, self._sustained = LAST_BIT, Sustained()
        self._begin()
        self._slide(to=rows)

    def _begin(self) -> None:
        """The path at the start, whatever was heard of the reference."""
        hop, rows, bins = self.hop, self._rows, self.hop + 1
        lead, shape = self._lead, (*self._lead, rows, bins)
        self._weights = np.zeros(shape, np.complex64)
        self._blocks = np.zeros((*lead, rows, 2 * hop), np.float32)
        self._blocks[..., : self.partitions, :hop] = self._initial.reshape(*lead, self.partitions, hop)
        fourier.rfft(self._blocks, out=self._weights)
        self._covariance = np.zeros(shape, np.float32)
        warm = self._initial.any()
        self._unknown = 0 if warm else UNKNOWN_HOPS
        if warm:
            power = fourier.power(self._weights[..., : self.partitions, :])
            late = np.float32(LATE_VARIANCE) * self._decay()
            self._expect(power.sum(axis=-2), late, np.float32(PRIOR_VARIANCE) * power)
        self._ageing, self._aged = (1.0 - self.adaptation.transition**2) * fourier.power(self._weights), 0
        self._noise = np.zeros((*lead, bins), np.float32)
        self._before, self._silent = np.zeros((*lead, bins), np.float32), True
        self._work = np.zeros(shape, np.complex64)
        self._expected = np.zeros(shape, np.float32)
        self._padded = np.zeros((*lead, 2 * hop), np.float32)
        self._shelves = ShelfStates()
        self._hops = self._active = 0
        self.volume = Volume(hop, "unscaled" if warm else "unknown", self._initial_gain)
        self._limiter = EchoLimiter(hop)

    def step(self, mic: Samples, reference: Samples, located: bool = True) -> CancellerOutput:
        """Cancel one hop: mic (hop,), of an array (microphones, hop), reference (hop,) float32, neither written to.

        located: whether the reference is known to lie where the microphone hears it; the path is adapted only then.
        """
        self._push(reference)
        path_echo = self._predict()
        if not np.vdot(path_echo, path_echo) < LOUDEST**2 * self.hop:  # it has diverged, also where it is no number
            self._diverged += 1
            self.reset()  # of the reference's past, too: it may be what made it diverge
            path_echo = self._predict()
        shelves = self._shelves
        heard, shelves.heard = self._lowered.step(mic, shelves.heard)
        echo = self._behind_path(path_echo, mic)
        turned = self.volume.follow(self._first_of(heard), self._first_of(echo)) if located else 1.0
        if turned != 1.0:
            self._weights *= np.float32(turned)
            for variance in (self._covariance, self._ageing):
                variance *= np.float32(turned**2)
            self._covariance += VOLUME_REOPENS * fourier.power(self._weights)
            echo = echo * np.float32(turned)
            shelves.echo *= turned
            self._limiter.turn(turned)
        excessive = self._limiter.measure(self._first_of(heard), self._first_of(echo))
        self._padded[..., self.hop :] = heard - echo
        innovation = mic - self._raised.step(echo, shelves.echo)[0]
        error_spectrum = fourier.rfft(self._padded)
        memory = self.adaptation.noise_memory
        self._noise *= memory
        self._noise += (1.0 - memory) * fourier.power(error_spectrum)
        self._hops += 1
        talks = np.vdot(self._played[0], self._played[0]) > LAST_BIT * self.hop
        if self._silent and not talks:
            self._before = self._noise.copy()
        self._silent = self._silent and not talks
        if located and talks and self._unknown:
            self._unknown -= 1
            self._expect_what_is_heard()
        np.multiply(self._covariance, self._powers, out=self._expected)
        misalignment = 0.5 * np.add.reduce(self._expected, axis=-2)
        if located and talks and not self.volume.suspected:
            self._active += 1
            if self._limiter.changed:
                np.maximum(self._covariance, REOPEN * fourier.power(self._weights), out=self._covariance)
                self._weights *= self._limiter.heard
            self._adapt(error_spectrum, 1.0 / (misalignment + self._noise + fourier.TINY))
            if self.adaptation.posterior and not excessive:
                echo = echo + (self._predict() - path_echo) if self.behind else self._predict()
        echo, shelves.echo = self._raised.step(echo, shelves.echo)
        echo = self._limiter.apply(echo)
        return CancellerOutput(echo, mic - echo, misalignment * self._raised.power, innovation)

    def _behind_path(self, path_echo: Samples, mic: Samples) -> Samples:
        """The predicted echo (..., hop) after the processing of the microphone (`behind`); it and mic have passed the low shelf."""
        if not self.behind:
            return path_echo
        shelves = self._shelves
        echo, shelves.path = self._raised.step(path_echo, shelves.path)
        echo, shelves.behind = self._lowered.step(self.behind(echo, mic), shelves.behind)
        return echo

    def tell_by(self, microphone: int) -> None:
        """Track the volume in this microphone from now on, and begin the path anew: it was scaled by the gain of the one before."""
        if microphone != self._teller:
            self._teller = microphone
            self._begin()

    def _predict(self) -> Samples:
        """Echo of the newest hop by the weights as they are, (hop,)."""
        np.multiply(self._weights, self._spectra, out=self._work)
        return fourier.irfft(np.add.reduce(self._work, axis=-2), 2 * self.hop)[..., self.hop :]

    def _first_of(self, x: Samples) -> Samples:
        """The microphone that tells for all, (hop,), of x (hop,) or (microphones, hop)."""
        return x if self.microphones is None else x[self._teller]

    def _push(self, reference: Samples) -> None:
        """Shift the reference's next hop into the spectra and powers (partitions, bins), the newest first among those of x, d x and d^2 x each."""
        self._recent[:, : self.hop] = self._recent[:, self.hop :]
        self._played[0] = reference
        if self.adaptation.products:
            self._scale_products(self._sustained.step(float(reference.dot(reference)) / self.hop))
            moved = self._displacement(reference)
            first = np.multiply(moved, reference, out=self._played[1])
            np.multiply(moved, first, out=self._played[2])
        self._recent[:, self.hop :], self._played_state = self._lowered.step(self._played, self._played_state)
        fresh = fourier.rfft(self._recent)
        rows = self._rows
        if self._at == 0:
            self._all_spectra[rows:], self._all_powers[rows:] = self._spectra, self._powers
            self._slide(to=rows)
        self._slide(to=self._at - 1)
        for row, spectrum, power in zip(self._first, fresh, fourier.power(fresh)):
            self._spectra[row], self._powers[row] = spectrum, power

    def _scale_products(self, loudness: float) -> None:
        """Bring the products to the size of a reference that holds this mean square, if it never was as loud; their paths stay."""
        if loudness <= self._loudest:
            return
        smaller, self._loudest = np.float32((self._loudest / loudness) ** 0.5), loudness
        self._moving *= smaller
        for order, first in enumerate(self._first[1:], 1):
            rows, scale = slice(first, first + PRODUCT_PARTITIONS), smaller**order
            self._recent[order] *= scale
            self._played_state[order] *= scale
            self._spectra[rows] *= scale
            self._powers[rows] *= scale**2

    def _slide(self, to: int) -> None:
        """Look at the rows from `to` on: one place on, all of the past is one place further down without being copied."""
        self._at, rows = to, slice(to, to + self._rows)
        self._spectra, self._powers = self._all_spectra[rows], self._all_powers[rows]

    def _displacement(self, reference: Samples) -> Samples:
        """Displacement of the membrane while it plays the next n samples of the reference, (n,); carries its state on."""
        moving = np.concatenate((self._moving, reference * np.float32(self._loudest**-0.5)))
        self._moving = moving[reference.size :]
        return np.clip(np.correlate(moving, self._lowpass_reversed, "valid"), -FURTHEST, FURTHEST)

    def _adapt(self, error_spectrum: np.ndarray, divisor: np.ndarray) -> None:
        """Kalman correction of weights and covariance, Enzner & Vary (2006), eq. (30)-(34)."""
        work, blocks, expected = self._work, self._blocks, self._expected
        np.conjugate(self._spectra, out=work)
        work *= self._covariance
        work *= (error_spectrum * divisor)[..., None, :]
        fourier.irfft(work, 2 * self.hop, out=blocks)
        blocks[..., self.hop :] = 0.0  # each partition keeps to hop taps (Shynk 1992)
        self._weights += fourier.rfft(blocks, out=work)
        kept = self.adaptation.transition**2
        expected *= (-self.adaptation.certainty * kept) * divisor[..., None, :]
        expected += kept
        self._covariance *= expected
        aged = slice(self._aged, self._aged + AGED_ROWS)
        self._ageing[..., aged, :] = (1.0 - kept) * fourier.power(self._weights[..., aged, :])
        self._aged = aged.stop if aged.stop < self._rows else 0
        self._covariance += self._ageing

    def _expect(self, path_power: Samples, decay: Samples, known: Samples | float = 0.0) -> None:
        """Raise the covariance where it is below decay (partitions, 1) times a path's power (bins,), plus a known variance."""
        rows = self._covariance[..., : self.partitions, :], self._covariance[..., self.partitions :, :]
        expected = known + decay * path_power[..., None, :], PRODUCT_VARIANCE * path_power[..., None, :]
        for row, variance in zip(rows, expected):
            np.maximum(row, variance, out=row)

    def _expect_what_is_heard(self) -> None:
        """Set the covariance of an unknown path by the powers of microphone and reference, whose scales nobody knows."""
        decay = self._decay()
        played = np.add.reduce(self._powers[: self.partitions], axis=0) / self.partitions
        heard = 2.0 * self._noise  # half of each block is the microphone, and nothing was subtracted from it yet
        emphasis = np.square(np.arange(self.hop + 1, dtype=np.float32))
        added = 2.0 * np.maximum(self._noise - self._before, 0.0)
        whole = np.add.reduce(emphasis * added, axis=-1) / (np.add.reduce(emphasis * played) + fourier.TINY)
        path_power = np.minimum(heard / (played + fourier.TINY), BOOST * whole[..., None])
        self._expect(path_power, UNKNOWN_VARIANCE / decay.sum() * decay)

    def _decay(self) -> Samples:
        """Power of a room's response, from 1 on, (partitions, 1)."""
        seconds = np.arange(self.partitions, dtype=np.float32) * self.hop / SAMPLE_RATE
        return np.power(np.float32(10.0), -6.0 * seconds / DECAY_RT60_S, dtype=np.float32)[:, None]

    def impulse_response(self) -> Samples:
        """The adapted path (taps,) float32, of an array (microphones, taps), to be written back into a profile."""
        blocks = fourier.irfft(self._weights[..., : self.partitions, :], 2 * self.hop)[..., : self.hop]
        return blocks.reshape(*self._lead, -1)

    def state(self) -> CancellerState:
        """Copies of what it knows of the path, without the reference that is under way."""
        return CancellerState(
            self.taps,
            self.adaptation,
            self._weights.copy(),
            self._covariance.copy(),
            self._noise.copy(),
            self.volume.gain,
            self._loudest,
            replace(self._shelves),
        )

    @classmethod
    def resumed(cls, state: CancellerState, hop: int) -> Canceller:
        """A canceller that goes on from that state, and anew from its path where it diverges; rewrite its reference first."""
        microphones = len(state.weights) if state.weights.ndim > 2 else None
        canceller = cls(hop, state.taps, adaptation=state.adaptation, microphones=microphones)
        canceller._weights[:], canceller._covariance[:] = state.weights, state.covariance
        canceller._noise[:], canceller._loudest = state.noise, state.loudest
        canceller._shelves = replace(state.shelves)
        canceller._ageing = (1.0 - state.adaptation.transition**2) * fourier.power(canceller._weights)
        canceller._unknown = 0 if canceller._covariance.any() else UNKNOWN_HOPS
        canceller._initial, canceller._initial_gain = canceller.impulse_response(), state.volume_gain
        canceller.volume = Volume(hop, gain=state.volume_gain)
        return canceller

    def rewrite_reference(self, history: Samples) -> None:
        """Replace the past of the reference by history (n,) float32, the last samples under a new delay before the hop that is stepped next.

        What is missing of `self.history` samples counts as silence.
        """
        past = np.concatenate((np.zeros(self.history), history), dtype=np.float32)[-self.history :]
        channels = past[None]
        if self.adaptation.products:
            self._moving = np.zeros(DISPLACEMENT_TAPS - 1, np.float32)
            moved = self._displacement(past)
            channels = np.stack((past, moved * past, moved * moved * past))
        self._played_state[:] = 0.0
        lowered = np.empty((past.size // self.hop, self._channels, self.hop), np.float32)
        for at, played in enumerate(channels.reshape(self._channels, -1, self.hop).swapaxes(0, 1)):
            lowered[at], self._played_state = self._lowered.step(played, self._played_state)
        for channel, first in enumerate(self._first):
            count = PRODUCT_PARTITIONS if first else self.partitions
            hops = lowered[::-1, channel]
            both = np.concatenate((hops[1 : count + 1], hops[:count]), axis=1)
            self._spectra[first : first + count] = fourier.rfft(both)
        self._powers[:] = fourier.power(self._spectra)
        self._recent[:] = lowered[-2:].swapaxes(0, 1).reshape(self._channels, -1)

    def stats(self) -> CancellerStats:
        """What the stage did so far."""
        return {
            "hops": self._hops,
            "active_hops": self._active,
            "partitions": self.partitions,
            "gain_db": 20.0 * float(np.log10(self.volume.gain)),
            "diverged": self._diverged,
        }
