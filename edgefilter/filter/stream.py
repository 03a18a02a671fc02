"""The whole data path: blocks in, alignment, linear stage, engine, overlap-add, finished samples out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from edgefilter.alignment.aligner import Aligned
from edgefilter.dsp import fourier
from edgefilter.dsp.stft import Synthesiser
from edgefilter.engines.base import ClipEngine, Engine, EngineState
from edgefilter.engines.spectral_subtraction import FLOOR
from edgefilter.errors import SignalError
from edgefilter.filter.barge_in import INTERRUPTIONS, SUSPICIONS, BargeIn, BargeInSettings, human_probability
from edgefilter.filter.echo_path import Learner
from edgefilter.filter.front_end import FrontEnd
from edgefilter.filter.reference_watch import ReferenceWatch
from edgefilter.filter.stepping import Stepping
from edgefilter.filter.turns import LONGEST_S, Turns, drop_sound
from edgefilter.profile.data import Profile
from edgefilter.types import (
    SAMPLE_RATE,
    Event,
    EventKind,
    Frame,
    Output,
    Samples,
    SoundFor,
    Turn,
    as_microphones,
    as_samples,
)

NOTHING: Samples = np.zeros((2, 0), np.float32)
"""No samples of the sound to recognise, and of the one to listen to."""
NOBODY = 0.17
"""Gain, -15 dB, of the sound to listen to where surely nobody speaks. On recordings of 15 real robots alone, on which it was chosen, that
sound is 37.5 dB below the microphone (36.6 with 0.2), the sound for a recogniser 26.9. With 56 humans laid on them, 6 to 14 dB below the
robot, its SI-SDR is 5.5 dB, that of the sound for a recogniser 5.6."""
SOFTER_HOPS = 3
"""Hops from a lower voice at the microphone until what the engine answers is of it alone: its fade, the window, the caller's block."""


class Stream:
    """Runs one engine over blocks of any length; whatever the partition, the output is bit-identical.

    All that has a name of `EgoFilter` is the same here; events and other are attributes. stepping: takes the compute time of
    every hop and may choose another engine, which becomes an event. queued: samples, as `EgoFilter.queued_s`.
    """

    def __init__(
        self,
        engine: Engine | ClipEngine,
        profile: Profile | None = None,
        stepping: Stepping | None = None,
        barge_in: BargeInSettings | None = None,
        learner: Learner | None = None,
        on_barge_in: Callable[[Event], object] | None = None,
        keep_channels: bool = False,
        on_suspicion: Callable[[Event], object] | None = None,
        output: SoundFor = "recognise",
    ) -> None:
        self.output = output
        self.engine, self.profile = engine, profile
        self.stepping, self.learner = stepping, learner
        self._barge_in_settings = barge_in
        self._called = {**dict.fromkeys(INTERRUPTIONS, on_barge_in), **dict.fromkeys(SUSPICIONS, on_suspicion)}
        self._keep_channels = keep_channels
        self.reset()

    @property
    def latency(self) -> int:
        """Algorithmic latency in samples: the window plus the engine's look-ahead, 0 for one that waits for the recording's end."""
        return self.engine.stft.window_length + (self.engine.lookahead or 0) * self.engine.stft.hop

    def reset(self) -> None:
        """Forget everything; the next sample is the first."""
        stft = self.engine.stft
        if self.stepping:
            self.stepping.reset()
        self.front = FrontEnd(self.engine, self.profile, self.learner)
        self._microphones: int | None = None
        self._watch = ReferenceWatch(stft.hop, stft.bins) if self.front.linear_stage else None
        self.events: deque[Event] = deque(maxlen=1000)
        self.speech_probability: float | None = None
        calibrated, moving = (not self.profile.learned, self.profile.while_moving) if self.profile else (False, None)
        self.barge_in = BargeIn(stft.hop / SAMPLE_RATE, self._barge_in_settings, calibrated, moving)
        self._turns = Turns(stft, self.front.spatial)
        self._removed: deque[Samples] = deque(maxlen=round(LONGEST_S * SAMPLE_RATE / stft.hop))
        self.samples_in = self.samples_out = self._stepped = 0
        self._state = None if self.engine.lookahead is None else self.engine.initial_state()
        self._clip: list[Frame] = []
        self._synthesiser = Synthesiser(stft, sounds=2)
        self._left_mic = self._left_ref = np.zeros(0, np.float32)  # of a hop that is not whole yet
        self._before_start = self.latency - stft.hop
        self._raised: BaseException | None = None
        self._kept = NOTHING
        self.other = NOTHING[1]
        self._flushed = False
        self.queued = 0

    def process(self, mic: Samples, ref: Samples) -> Samples:
        """Take mic (n,), of an array (n, channels), and ref (n,); return what is finished, 0 to n + latency samples."""
        mic, ref = as_microphones(mic, "mic"), as_samples(ref, "ref")
        if self._flushed:
            raise SignalError("the stream has been flushed, its end is written: call reset() before the next recording")
        if mic.shape[-1] != ref.size:
            found = f"mic has {mic.shape[-1]} samples and ref {ref.size}"
            raise SignalError(f"{found}, expected as many of each: pad the shorter with zeros")
        self._expect(None if mic.ndim == 1 else len(mic))
        self.samples_in += ref.size
        return self._deliver(self._run(mic, ref))

    def robot_removed(self) -> Samples:
        """Each microphone with the linear stage's echo subtracted, since the last call, 30 s at most, (n, microphones)."""
        removed = list(self._removed)
        self._removed.clear()
        return np.concatenate(removed) if removed else np.zeros((0, self._microphones or 1), np.float32)

    def flush(self) -> Samples:
        """Return the samples that process still holds back; the stream can then only be reset."""
        missing = 0 if self._flushed else self.samples_in - self.samples_out
        self._flushed = True
        padding = np.zeros(self.latency + self.engine.stft.hop, np.float32)
        if not missing:
            return self._deliver(NOTHING)
        lead = () if self._microphones is None else (self._microphones,)
        rest = self._run(np.zeros((*lead, padding.size), np.float32), padding)
        if self.engine.lookahead is None:
            answer = self.engine.answer(self._clip)
            rest = self._finish([self._synthesiser.push(np.stack((spectrum, spectrum))) for spectrum in answer])
        if talk := self.barge_in.end():
            self._tell_of_speech(talk, "the recording has ended")
        return self._deliver(rest[:, :missing])

    def _expect(self, microphones: int | None) -> None:
        """Be ready for that many microphones, None for one; SignalError where the recording so far, or the profile, has another number."""
        if self.samples_in == 0:
            known = 1 if self.profile is None else self.profile.microphones
            if self.profile and known != (microphones or 1):
                raise SignalError(
                    f"mic has {microphones or 1} channels and the profile {known}, expected as many: choose the channels"
                    " that were calibrated, or calibrate again with these"
                )
            if microphones != self._microphones:
                self.front = FrontEnd(self.engine, self.profile, self.learner, microphones, self.front.aligner)
                self._turns = Turns(self.engine.stft, self.front.spatial)
                self._microphones = microphones
                self._left_mic = np.zeros((microphones, 0) if microphones else 0, np.float32)
        if microphones != self._microphones:
            found = f"mic has {microphones or 1} channels after {self._microphones or 1}"
            raise SignalError(f"{found}, expected the same number until the end: call reset() before another recording")

    def _deliver(self, out: Samples) -> Samples:
        """The sound that was asked for, of the finished samples (2, n) behind those kept; all are kept where a callback has raised."""
        if self._kept.size:
            out = np.concatenate((self._kept, out), axis=1)
        error, self._raised = self._raised, None
        self._kept = out if error else out[:, :0]
        if error:
            raise error
        wanted, self.other = out if self.output == "recognise" else out[::-1]
        return wanted

    def _run(self, mic: Samples, ref: Samples) -> Samples:
        hop = self.engine.stft.hop
        mic, ref = np.concatenate((self._left_mic, mic), axis=-1), np.concatenate((self._left_ref, ref))
        whole = ref.size - ref.size % hop
        self._left_mic, self._left_ref = mic[..., whole:].copy(), ref[whole:].copy()
        return self._finish(
            [
                self._watched_step(np.ascontiguousarray(mic[..., at : at + hop]), ref[at : at + hop])
                for at in range(0, whole, hop)
            ]
        )

    def _finish(self, done: list[Samples]) -> Samples:
        """What of the synthesised hops (2, hop) belongs to samples that came in, and not to the silence before them."""
        if not done:
            return NOTHING
        out = done[0] if len(done) == 1 else np.concatenate(done, axis=1)
        early = min(self._before_start, out.shape[1])
        self._before_start -= early
        self.samples_out += out.shape[1] - early
        return out[:, early:]

    def _watched_step(self, mic: Samples, ref: Samples) -> Samples:
        """One hop; its compute time is watched, but not the learner's, which is another process in a live run."""
        began = self.stepping.clock() if self.stepping else 0.0
        out = self._step(mic, ref)
        if self.stepping and (happened := self.stepping.note(self.stepping.clock() - began)):
            self._tell(*happened)
        if self.learner and self.front.linear_stage and not (self._watch and self._watch.same):
            self.front.linear_stage.learn()
        return out

    def _step(self, mic: Samples, ref: Samples) -> Samples:
        self._stepped += ref.size
        frame, aligned = self.front.step(mic, ref)
        if self._keep_channels and self.front.linear:
            self._removed.append(np.atleast_2d(self.front.linear.error).T)
        if aligned and aligned.realigned:
            self._tell("realigned", f"echo found {1000 * aligned.delay / SAMPLE_RATE:.1f} ms after the reference")
        if self._watch and aligned and (stage := self.front.linear_stage):
            speaking = self.barge_in.speaking
            for kind, detail in self._watch.step(self.front.heard, ref, aligned, frame, stage.removal, speaking):
                self._tell(kind, detail)
            if stage.update:
                self._tell(stage.update.kind, stage.update.detail)
        engine = self.engine
        if engine.lookahead is None:
            self._collect(frame, engine)
            return NOTHING
        output, self._state = step(engine, frame, self._state)
        sounds = output.sounds
        if output.speech_probability is not None:
            self._turns.step(sounds[0], frame.error, self.front.errors)
        said = output.speech_probability
        human = None if said is None else human_probability(said)
        self._judge_speech(human, frame, aligned)
        self.front.hear(frame, output, self.speech_probability, self.barge_in.speaking)
        if human is not None and not self.barge_in.speaking:
            sounds[1] *= np.float32(NOBODY ** (1.0 - human))
        return self._synthesiser.push(sounds)

    @property
    def voice_gain(self) -> float:
        """As of `EgoFilter`."""
        return 10.0 ** (-self.barge_in.settings.ask_db / 20.0) if self.barge_in.asking else 1.0

    def _softer_after(self, frame: Frame, aligned: Aligned | None) -> int:
        """Hops until a robot's voice that is lowered now arrives lower at the microphone; 0 where it cannot be lowered or is not heard."""
        if not self.barge_in.settings.ask_db or frame.idle or aligned is None or not math.isfinite(aligned.delay):
            return 0
        return SOFTER_HOPS + math.ceil((self.queued + max(aligned.delay, 0.0)) / self.engine.stft.hop)

    def _judge_speech(self, probability: float | None, frame: Frame, aligned: Aligned | None) -> None:
        self.speech_probability = probability
        wait, gain = 0, self.voice_gain
        if probability is not None:
            wait = self._watch.wait // self.engine.stft.hop if self._watch else 0
            self.speech_probability = 0.0 if self._watch and self._watch.suspect else probability
        heard = not (frame.idle or frame.at_any_lag)
        if talk := self.barge_in.note(self.speech_probability, wait, self._softer_after(frame, aligned), heard):
            self._tell_of_speech(talk, f"probability {self.speech_probability or 0.0:.2f}")
            if call := self._called.get(talk):
                try:
                    call(self.events[-1])
                except BaseException as error:  # the rest of the block is filtered first
                    self._raised = self._raised or error
        if self.voice_gain != gain:
            self._tell("voice_gain", f"{self.voice_gain:.3f}")

    def _tell(self, kind: EventKind, detail: str, turn: Turn | None = None, sound: Turn | None = None) -> None:
        self.events.append(Event(kind, self._stepped, detail, turn, sound))

    def _tell_of_speech(self, talk: EventKind, detail: str) -> None:
        if talk == "speech_started":
            self._turns.start(self.barge_in.waited)
            self._tell(talk, detail, sound=self._turns.recent(self.barge_in.waited))
        elif talk == "speech_stopped":
            self._tell(talk, detail, self._turns.finish(), self._turns.recent())
            drop_sound(self.events)
        else:
            self._tell(talk, detail)

    def _collect(self, frame: Frame, engine: ClipEngine) -> None:
        self._clip.append(frame)
        if len(self._clip) > engine.longest:
            seconds = engine.longest * engine.stft.hop / SAMPLE_RATE
            raise SignalError(
                f"the recording is longer than {seconds:.0f} s, which is all that engine {engine.name} takes at"
                " once: shorten the recording or take another engine"
            )


def step(engine: Engine, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
    """The engine's answer and its next state.

    While nothing tells robot from human (frame.at_any_lag) the answer is the error, lowered to FLOOR times the stationary
    noise's amplitude, the probability of speech is 0, and the engine's state stays.
    """
    output, following = engine.step(frame, state)
    if not frame.at_any_lag:
        return output, following
    power = fourier.power(frame.error)
    noise = FLOOR * np.sqrt(np.minimum(frame.noise_psd, power) / (power + fourier.TINY)) * frame.error
    return Output(noise, None if output.speech_probability is None else 0.0), state
