"""What stands before the engine: alignment, linear stage and what is known of the rest, one hop at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edgefilter.alignment.aligner import Aligner
from edgefilter.alignment.delay_line import UNLOCATED, Aligned
from edgefilter.alignment.paper import PaperAligner
from edgefilter.dsp.stft import Analyser, StftConfig
from edgefilter.echo.source_chain import SourceChain
from edgefilter.engines.base import ClipEngine, Engine
from edgefilter.filter.canceller import Canceller, CancellerOutput
from edgefilter.filter.onset_gate import GATE, OnsetGate
from edgefilter.filter.residual_echo import Residual, Unpredictable
from edgefilter.profile.data import Profile
from edgefilter.types import Frame, Samples

TAPS = (2048, 8192)
"""Least and most taps of the linear stage, 128 to 512 ms; between them the profile's impulse response decides."""

RUMBLE_HZ, RUMBLE = 90.0, 0.05
"""Below this frequency a microphone whose path nobody measured hears rooms, not people; it is lowered by 26 dB."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearStage:
    """What the kind "full" alone has: the tracked delay, the source's effects, the canceller and what it leaves."""

    aligner: Aligner
    source: SourceChain
    canceller: Canceller
    residual: Residual

    def step(self, mic: Samples, aligned: Aligned) -> CancellerOutput:
        """One hop (hop,) of the microphone, with what the aligner found in it."""
        if aligned.realigned:
            wanted = max(self.canceller.history, self.source.memory)
            past = self.source.restart(self.aligner.history(wanted)[: -mic.size])
            driven = self.source(aligned.reference)
            self.canceller.rewrite_reference(np.concatenate((past, driven)))
        else:
            driven = self.source(aligned.reference)
        return self.canceller.step(mic, driven, aligned.state not in UNLOCATED)


class FrontEnd:
    """Finds the reference in the microphone and subtracts what is linear of it.

    kind "none" passes the microphone, "paper" only delays the reference per utterance, "full" tracks and cancels.
    aligner: None for "none". linear_stage: None but for "full". gate: None but for "full" with a profile.
    """

    def __init__(self, engine: Engine | ClipEngine, profile: Profile | None) -> None:
        stft = engine.stft
        self.hop = stft.hop
        self.aligner: Aligner | PaperAligner | None = None
        self.gate: OnsetGate | None = None
        self.linear_stage: LinearStage | None = None
        source = profile.echo.source_chain() if profile else SourceChain()
        if engine.front == "paper":
            self.aligner = PaperAligner(stft.hop)
        elif engine.front == "full":
            self.aligner = aligner = Aligner(stft.hop, profile)
            response = profile.echo.running_response() if profile else None
            if response is not None:
                self.gate = OnsetGate(stft.hop, float(np.sum(np.square(response))))
            canceller = self._make_canceller(profile, response)
            self.linear_stage = LinearStage(aligner, source, canceller, Residual(stft, profile))
            self._unpredictable = Unpredictable(stft, source.colours) if source.colours else None
        self._analyser = Analyser(stft, channels=4 if self.linear_stage else 2)
        self._low_cut = None if profile or not self.linear_stage else low_cut(stft)
        self._nothing = np.zeros(stft.bins, np.float32)
        self._fan = profile.noise_bins(stft) if profile else self._nothing
        self._silence = np.zeros(stft.bins, np.complex64)

    def _make_canceller(self, profile: Profile | None, response: Samples | None) -> Canceller:
        if profile is None or response is None:
            return Canceller(self.hop)
        taps, voice = int(np.clip(response.size, *TAPS)), profile.echo.voice_chain()
        return Canceller(self.hop, taps=taps, impulse_response=response, behind=voice or None)

    def step(self, mic: Samples, ref: Samples) -> tuple[Frame, Aligned | None]:
        """One hop (hop,) of both channels to one frame, with what the aligner found."""
        stage = self.linear_stage
        if stage is None:
            found = self.aligner.step(mic, ref) if self.aligner else None
            x, r = self._analyser.push(mic, found.reference if found else ref)
            return Frame(x, r, self._silence, x, self._fan, self._nothing), found
        aligned = stage.aligner.step(mic, ref)
        linear = stage.step(mic, aligned)
        signals = np.stack((mic, aligned.reference, linear.echo, linear.error))
        if self.gate and (gain := self.gate.step(mic, ref, aligned)) is not None:
            signals[[0, 2, 3]] *= gain
            if self.gate.shuts:
                self._analyser.scale_past(GATE)
        spectra = self._analyser.push(*signals)
        if self._low_cut is not None:
            spectra *= self._low_cut
        x, r, e, error = spectra
        added = self._unpredictable.step(stage.source.expected) if self._unpredictable else None
        noise, residual = stage.residual.step(e, error, linear.uncertainty, added)
        return Frame(x, r, e, error, noise, residual), aligned

    def signals(self, mic: Samples, ref: Samples) -> tuple[Samples, Samples]:
        """One hop (hop,) of both channels to the aligned reference and the linear stage's error, (hop,) each, as training wants them.

        The kind "full" alone has them.
        """
        assert self.linear_stage is not None
        aligned = self.linear_stage.aligner.step(mic, ref)
        return aligned.reference, self.linear_stage.step(mic, aligned).error


def low_cut(stft: StftConfig) -> Samples:
    """(bins,) gain without phase: RUMBLE below RUMBLE_HZ, 1 above."""
    return np.where(stft.frequencies < RUMBLE_HZ, np.float32(RUMBLE), np.float32(1.0))
