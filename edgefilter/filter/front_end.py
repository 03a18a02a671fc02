"""The front end: alignment, echo cancellation, and estimates of noise and residual echo, one hop at a time."""

from __future__ import annotations

import numpy as np

from edgefilter.alignment.aligner import UNLOCATED, Aligned, Aligner
from edgefilter.alignment.delay_line import WAIT
from edgefilter.alignment.paper import PaperAligner
from edgefilter.dsp import fourier
from edgefilter.dsp.stft import Analyser
from edgefilter.echo.running import SourceChain
from edgefilter.engines.base import ClipEngine, Engine
from edgefilter.filter.canceller import Canceller, CancellerOutput
from edgefilter.filter.echo_path import PAST, EchoPath, FilteredHop, Learner, PathUpdate, starting_path
from edgefilter.filter.hum import Hum
from edgefilter.filter.microphones import Microphones
from edgefilter.filter.removal import Removal
from edgefilter.filter.residual_echo import Residual, Unpredictable
from edgefilter.filter.spatial import SpatialFilter
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Frame, LinearStageStats, Output, Samples, Spectrum

RUMBLE_HZ, RUMBLE = 90.0, 0.05
"""Below this frequency a microphone without a calibration picks up the room, not people; it is lowered by 26 dB."""
OFFSET_S = 0.5
"""Time constant, seconds, with which a constant offset of the microphone is followed: at 60 Hz it turns the phase by 0.3 degrees."""


class Centred:
    """Takes a constant offset off a signal, hop by hop: its running mean at first, later what the last OFFSET_S had."""

    def __init__(self, hop: int) -> None:
        self._follow = np.float32(hop / (OFFSET_S * SAMPLE_RATE))
        self._mean = np.float32(1.0 / hop)
        self._ramp = np.arange(1, hop + 1, dtype=np.float32) * self._mean
        self._hops = 0
        self._offset: Samples | None = None

    def step(self, x: Samples) -> Samples:
        """The next hop x (..., hop) without its offset."""
        mean = self._mean * np.add.reduce(x, axis=-1, keepdims=True)
        before, self._hops = mean if self._offset is None else self._offset, self._hops + 1
        moved = max(self._follow, np.float32(1.0 / self._hops)) * (mean - before)
        self._offset = before + moved
        offset = moved * self._ramp
        offset += before
        return np.subtract(x, offset, out=offset)


class LinearStage:
    """Tracked delay, echo path and residual echo: what only front ends of the kind "full" have.

    learner: told of every hop; the update that it answers is adopted with the next one. update: adopted in the latest hop.
    """

    update: PathUpdate | None = None
    _next: PathUpdate | None = None
    _latest: FilteredHop | None = None

    def __init__(self, aligner: Aligner, path: EchoPath, residual: Residual, learner: Learner | None = None) -> None:
        self.aligner = aligner
        self.path = path
        self.residual = residual
        self.removal = Removal(aligner.hop)
        self._learner = learner
        self._fade = np.linspace(0.0, 1.0, aligner.hop, dtype=np.float32)
        if learner:
            learner.start(path.state(), aligner.hop)

    @property
    def canceller(self) -> Canceller:
        """The adaptive filter in use."""
        return self.path.canceller

    def step(self, mic: Samples, aligned: Aligned) -> CancellerOutput:
        """One hop (hop,) of the microphone, of an array (microphones, hop), with what the aligner found in it."""
        located = aligned.state not in UNLOCATED
        past = self._past() if aligned.realigned else None
        output = self.path.step(mic, aligned.reference, located, past)
        self.update, self._next = self._next, None
        if self.update:
            output = self._adopt(self.update, mic, aligned.reference, located, output)
        if self._learner:
            idle = aligned.state == "idle"
            self._latest = FilteredHop(mic, aligned.reference, output.innovation, located, idle, past, aligned.delay)
        return output

    def stats(self) -> LinearStageStats:
        """What it did so far, and what it removes now."""
        return {**self.canceller.stats(), "removed_db": self.removal.removed_db}

    def learn(self) -> None:
        """Tell the learner of the latest hop."""
        if self._learner and self._latest:
            self._next = self._learner.observe(self._latest)

    def _adopt(
        self, update: PathUpdate, mic: Samples, reference: Samples, located: bool, before: CancellerOutput
    ) -> CancellerOutput:
        """Fade from this hop's output of the old path (before) to that of the learned path."""
        self.path = EchoPath.resumed(update.path, self._past(), reference.size)
        after = self.path.step(mic, reference, located)
        echo = before.echo + self._fade * (after.echo - before.echo)
        return CancellerOutput(echo, mic - echo, after.uncertainty, after.innovation)

    def _past(self) -> Samples:
        return self.aligner.history(max(self.path.history, PAST if self._learner else 0))


class FrontEnd:
    """Finds the reference in the microphone and subtracts its linear echo.

    The engine's `front` is its kind: "full", "none" and others (engines/base.py). aligner: None if "none". linear_stage: None unless
    "full". cut: (bins,) gain of every spectrum, None for 1. microphones: their number in an array, None for a single one; kinds
    without a linear stage use the first alone. spatial: None unless "full" with an array. errors: (microphones, bins), what is left
    of an array's latest frame. linear: the linear stage's output of the latest hop. heard: the microphone's latest hop, (hop,),
    without its offset and hum.
    """

    def __init__(
        self,
        engine: Engine | ClipEngine,
        profile: Profile | None,
        learner: Learner | None = None,
        microphones: int | None = None,
        aligner: Aligner | PaperAligner | None = None,
    ) -> None:
        stft = engine.stft
        self._stft = stft
        self.microphones: Microphones | None = None
        if microphones:
            self.microphones = Microphones(microphones, stft.hop, profile.running_responses() if profile else None)
        self.aligner = aligner
        self.spatial: SpatialFilter | None = None
        self.errors: Spectrum | None = None
        self.linear: CancellerOutput | None = None
        self.linear_stage: LinearStage | None = None
        if engine.front == "paper":
            self.aligner = aligner or PaperAligner(stft.hop)
        elif engine.front == "full":
            self.aligner = tracking = aligner if isinstance(aligner, Aligner) else Aligner(stft.hop, profile)
            path = starting_path(profile, stft.hop, microphones)
            self.linear_stage = LinearStage(tracking, path, Residual(stft, profile), learner)
            self._source: SourceChain | None = None
            if microphones:
                tracking.hear_by(range(microphones))
                noise = profile.array.noise_covariance(stft) if profile and profile.array else None
                self.spatial = SpatialFilter(stft, microphones, noise)
        channels = 2 if self.linear_stage is None else 4 if microphones is None else 1 + 2 * microphones
        self._analyser = Analyser(stft, channels)
        self.cut: Samples | None = None
        if self.linear_stage and not profile:
            self.cut = np.where(stft.frequencies < RUMBLE_HZ, np.float32(RUMBLE), np.float32(1.0))
        self._centred, self._hum = Centred(stft.hop), Hum(stft.hop)
        self.heard = np.zeros(stft.hop, np.float32)
        self._tail: Samples | None = None
        self._nothing = np.zeros(stft.bins, np.float32)
        self._noise = profile.noise_bins(stft) if profile else self._nothing
        self._silence = np.zeros(stft.bins, np.complex64)
        self._before = False

    def step(self, mic: Samples, ref: Samples) -> tuple[Frame, Aligned | None]:
        """One hop (hop,) of microphone, of an array (microphones, hop), and reference to a frame, with what the aligner found."""
        stage = self.linear_stage
        if stage:
            mic = self._hum.step(self._centred.step(mic))
        heard, mic = mic, self.first_of(mic)
        self.heard = mic
        if stage is None:
            found = self.aligner.step(mic, ref) if self.aligner else None
            x, r = self._analyser.push(mic, found.reference if found else ref)
            return Frame(x, r, self._silence, x, self._noise, self._nothing), found
        if self.microphones:
            stage.canceller.tell_by(self.microphones.first)
        aligned = stage.aligner.step(heard, ref)
        heard = self._waiting(heard, aligned.wait)
        mic = self.first_of(heard)
        self.linear = linear = stage.step(heard, aligned)
        if aligned.state not in UNLOCATED:
            stage.removal.step(mic, aligned.reference, CancellerOutput(*map(self.first_of, linear)))
        added = self._added(stage.path.source)
        if self.spatial and self.microphones:
            located = aligned.state == "locked"
            if self.microphones.step(heard, linear.error, ref, aligned.reference, located):
                self.spatial.use(self.microphones.used)
                stage.aligner.hear_by(np.flatnonzero(self.microphones.used).tolist())
            r, (x, e, error) = self._combined(self.spatial, heard, aligned.reference, linear.echo, aligned.wait)
            uncertainty, fan = self.spatial.independent(linear.uncertainty), self.spatial.fan_psd()
            noise, residual = stage.residual.step(e, error, uncertainty, added, fan)
        else:
            x, r, e, error = self._spectra(mic, aligned.reference, linear.echo, linear.error, wait=aligned.wait)
            noise, residual = stage.residual.step(e, error, linear.uncertainty, added)
        at_any_lag, self._before = aligned.at_any_lag or self._before, aligned.at_any_lag  # a frame is two hops
        return Frame(x, r, e, error, noise, residual, aligned.state == "idle", at_any_lag), aligned

    def _waiting(self, mic: Samples, wait: int) -> Samples:
        """The hop of mic (..., hop) that ends `wait` samples, at most WAIT, before the latest sample."""
        before = np.zeros((*mic.shape[:-1], WAIT), np.float32) if self._tail is None else self._tail
        heard = np.concatenate((before, mic), axis=-1)
        self._tail = heard[..., -WAIT:]
        return heard[..., WAIT - wait : heard.shape[-1] - wait]

    def first_of(self, mic: Samples) -> Samples:
        """Of all (microphones, ...) that of the microphone that the answer sounds like (...,); of a single one as it is."""
        return mic if self.microphones is None else mic[self.microphones.first]

    def _spectra(self, *signals: Samples, wait: int) -> Spectrum:
        """Spectra of k signals (hop,), each delayed by `wait` samples, (k, bins)."""
        spectra = self._analyser.push(*signals, wait=wait)
        if self.cut is not None:
            spectra *= self.cut
        return spectra

    def _combined(
        self, spatial: SpatialFilter, mic: Samples, reference: Samples, echo: Samples, wait: int
    ) -> tuple[Spectrum, Spectrum]:
        """Spectra (bins,) of the reference, and (3, bins) of microphones, echo and error through the spatial filter."""
        count = len(mic)
        spectra = self._spectra(reference, *mic, *echo, wait=wait)
        self.errors = spectra[1 : 1 + count] - spectra[1 + count :]
        x, error = spatial.step(np.stack((spectra[1 : 1 + count], self.errors)))
        return spectra[0], np.stack((x, x - error, error))

    def hear(self, frame: Frame, output: Output, probability: float | None, speaking: bool) -> None:
        """Tell residual echo and spatial filter what the engine made of the latest frame, and whether a human speaks.

        probability: None from an engine that does not judge it; the share of what exceeds fan and residual echo then
        stands for it, and for the mask. Frames that may hold the robot at any lag teach nothing.
        """
        if self.linear_stage:
            self.linear_stage.residual.nobody_speaks = probability is not None and not speaking
        if self.spatial is None or self.errors is None or frame.at_any_lag:
            return
        power = fourier.power(frame.error)
        if probability is None:
            gain = np.maximum(power - (frame.noise_psd + frame.residual_psd), 0.0) / (power + fourier.TINY)
            probability = float(np.mean(gain))
        else:
            gain = np.sqrt(np.minimum(fourier.power(output.spectrum), power) / (power + fourier.TINY))
        self.spatial.learn(self.errors, gain, probability, speaking, frame.idle)

    def _added(self, source: SourceChain) -> Samples | None:
        """Expected power of the effects that no waveform predicts, for the path in use, which an update changes, (bins,)."""
        if source is not self._source:
            self._source = source
            self._unpredictable = Unpredictable(self._stft, source.colours) if source.colours else None
        return self._unpredictable.step(source.expected) if self._unpredictable else None
