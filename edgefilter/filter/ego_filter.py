"""What users of the library hold: EgoFilter, for blocks as they come, and enhance, for a whole recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from edgefilter import engines
from edgefilter.alignment.utterances import MOST_ANNOUNCED, MOST_ANNOUNCED_S
from edgefilter.dsp.resample import at_16_khz, from_16_khz
from edgefilter.engines.base import ClipEngine, Engine
from edgefilter.engines.combined import Fallback, fallbacks, judges_speech, with_network_as_judge
from edgefilter.errors import EdgefilterError, SignalError, UsageError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.echo_path import Learner
from edgefilter.filter.stepping import Stepping
from edgefilter.filter.stream import Stream
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Event, Samples, SoundFor, Stats, as_samples

if TYPE_CHECKING:
    from edgefilter.engines.onnx_session import Model


class EgoFilter:
    """The object to put in front of a recogniser: give it what the microphone hears and what the robot says.

    Parameters
    ----------
    profile : Profile, str or Path, optional
        The calibrated robot, or the file that holds it. Without one the echo path is learnt from nothing.
    engine : str
        One of `edgefilter.ENGINES`, or "auto" for the strongest that can be made here.
    budget_ms : float, optional
        Milliseconds of computing that a hop may take. If hops take longer for some time, a cheaper engine takes over
        (see Stepping), and an event says so. Without a budget the engine is never changed and missed deadlines are only
        counted. The budget has no effect with judge="network" in `barge_in`, since only the network judges speech there,
        nor with an engine that waits for the end of the recording; `engine_reason` then says so.
    model : str or Path, optional
        The ONNX file that a neural engine, named in `engine`, loads in place of its own.
    barge_in : BargeInSettings, optional
        When speech counts as begun and as ended; `BargeInSettings` says what to choose.
    learn : BackgroundLearner or PathLearner, optional
        Learns loudspeaker and room while the filter runs, in another process or, for recordings, in this one; engines
        without a linear stage do not need it. One learner serves one filter.
    on_barge_in : callable, optional
        Called with the `Event` when a human's speech has begun, from inside `process` and in the same hop, if the engine
        judges speech (`speech_probability` is not None). It should stop or duck the robot and return at once, since the
        audio waits for it. An exception that it raises is raised by `process` after the block is filtered; no sample is
        lost, the next `process` or `flush` returns those of this block as well.
    keep_channels : bool
        Keep the output of the linear stage for each microphone channel, for `robot_removed`.
    on_suspicion : callable, optional
        Called in the same way with "speech_suspected", some 50 ms before a human's speech counts as begun, and with
        "speech_dismissed" where nobody spoke, `BargeInSettings.confirm_s` later at most, or after a lower voice is heard.
    output : str
        Which of two sounds `process` returns; `other` gives the other one. "recognise": for a recogniser; while the robot is
        silent it keeps more of the fan and has fewer gaps in the voice. "listen": for a call, a level meter or a detector of speech;
        up to 14 dB lower where the engine hears nobody speak. An engine without a network has one sound for both. Events do
        not depend on it, and turns always hold the sound for a recogniser.

    Attributes
    ----------
    profile : Profile or None
        The calibrated robot, loaded.
    engine_reason : str
        Why this engine; whoever has chosen it may say so here.

    Raises
    ------
    UsageError
        For an unknown engine or output, an engine that lacks its profile, or a model without an engine for it.
    ProfileError, ModelError
        For a file that is damaged or of another version.

    Notes
    -----
    The path, hop by hop: alignment of the reference, a partitioned-block frequency-domain Kalman filter (Enzner & Vary
    2006) that subtracts the echo, the engine's mask on what is left, overlap-add (docs/architecture.md). Samples are
    float, full scale +-1, at 16 kHz; of two to eight microphones the path makes one channel (docs/arrays.md). Any partition
    into blocks gives the same output to the last bit.

    Examples
    --------
    `with` closes it at the end, and the learner with it.

    >>> import numpy as np
    >>> human = np.sin(np.arange(1000) / 10).astype(np.float32)
    >>> with EgoFilter(engine="bypass") as ego:
    ...     out = np.concatenate((ego.process(human, np.zeros_like(human)), ego.flush()))
    >>> bool(np.allclose(out, human, atol=1e-6))
    True
    """

    def __init__(
        self,
        profile: Profile | str | Path | None = None,
        *,
        engine: str = "auto",
        budget_ms: float | None = None,
        model: str | Path | None = None,
        barge_in: BargeInSettings | None = None,
        learn: Learner | None = None,
        on_barge_in: Callable[[Event], object] | None = None,
        keep_channels: bool = False,
        on_suspicion: Callable[[Event], object] | None = None,
        output: SoundFor = "recognise",
    ) -> None:
        if output not in get_args(SoundFor):
            raise UsageError(f"found output '{output}', expected one of {', '.join(get_args(SoundFor))}")
        if engine == "auto" and model is not None:
            raise UsageError(
                f"found the model {model} without an engine for it: name one of {', '.join(engines.HAVE_MODEL)}"
            )
        self.profile = Profile.load(profile) if isinstance(profile, str | Path) else profile
        best, self.engine_reason = (
            strongest(self.profile)
            if engine == "auto"
            else (engines.create(engine, self.profile, model=model), "asked for")
        )
        network_judges = barge_in is not None and barge_in.judge == "network"
        if network_judges:
            best = with_network_as_judge(best, self.profile)
        fallback = None
        if budget_ms is not None:
            if network_judges or best.lookahead is None:
                why = (
                    "none is cheaper than the network that judges speech" if network_judges else "it waits for the end"
                )
                self.engine_reason += f"; a budget of {budget_ms:g} ms does not change the engine: {why}"
            else:
                fallback = Fallback(fallbacks(best, self.profile))
        stepping = Stepping(best.stft.hop, fallback, budget_ms)
        hooks = on_barge_in, keep_channels, on_suspicion, output
        self._stream = Stream(fallback or best, self.profile, stepping, barge_in, learn, *hooks)

    @property
    def _engines(self) -> Sequence[Engine | ClipEngine]:
        engine = self._stream.engine
        return engine.engines if isinstance(engine, Fallback) else (engine,)

    @property
    def _engine(self) -> Engine | ClipEngine:
        engine = self._stream.engine
        return engine.engines[engine.wanted] if isinstance(engine, Fallback) else engine

    @property
    def engine_name(self) -> str:
        """The engine at work; during a crossfade the one that takes over."""
        return self._engine.name

    @property
    def latency(self) -> int:
        """Algorithmic latency, samples."""
        return self._stream.latency

    @property
    def waits_for_end(self) -> bool:
        """Whether the engine needs the whole recording: process then returns nothing, flush everything."""
        return self._stream.engine.lookahead is None

    @property
    def hop(self) -> int:
        """Samples between two steps of the engine: the block length with the least overhead."""
        return self._stream.engine.stft.hop

    @property
    def speech_probability(self) -> float | None:
        """Probability that the human speaks now, 0 to 1: what the network says of the latest hop, calibrated.

        None before the first hop and with engines that do not judge it, and give no events of speech: all but crnn, unless
        barge-in has judge="network". 0 while the robot's lag is not found yet, or its reference comes later.
        """
        return self._stream.speech_probability

    @property
    def human_speaks(self) -> bool:
        """Whether the human is speaking, pauses of half a second included; False where the engine does not judge it."""
        return self._stream.barge_in.speaking

    @property
    def voice_gain(self) -> float:
        """Gain with which the robot should speak now: below 1 while somebody is suspected to speak (`BargeInSettings.ask_db`), else 1.

        Whoever plays fades to it within some 10 ms, and hands over as the reference what is played then. An event
        "voice_gain" tells of each change.
        """
        return self._stream.voice_gain

    @property
    def queued_s(self) -> float:
        """Seconds of speech that the loudspeaker has been handed and has not played yet; whoever knows it says so here, 0 at first.

        Such speech cannot be lowered any more. Where a lower voice would be heard too late (`BargeInSettings.confirm_s`),
        the robot is not asked to lower it.
        """
        return self._stream.queued / SAMPLE_RATE

    @queued_s.setter
    def queued_s(self, seconds: float) -> None:
        self._stream.queued = round(seconds * SAMPLE_RATE)

    @property
    def judges_speech(self) -> bool:
        """Whether the engine, and each cheaper one that may take over, tells whether a human speaks."""
        return all(judges_speech(engine) for engine in self._engines)

    def process(self, mic_block: Samples, ref_block: Samples) -> Samples:
        """Take the next block of both channels and return the samples that are finished.

        Parameters
        ----------
        mic_block : ndarray of float, shape (n,) or (n, channels)
            What the microphone heard, or two to eight microphones on one clock, as many in each block; any n. Never
            written to.
        ref_block : ndarray of float, shape (n,)
            What the robot said meanwhile, on the same sample counter. Never written to.

        Returns
        -------
        ndarray of float32, shape (m,)
            Aligned with the input: sample i of all outputs belongs to sample i of all inputs. m is 0 to n + latency.

        Raises
        ------
        SignalError
            For another shape or dtype, unequal lengths, samples that are not finite or beyond 1e6, other microphones
            than before or than the profile's, or after `flush`.
        """
        return self._stream.process(mic_block, ref_block)

    def other(self) -> Samples:
        """The other sound (see `output` of the class) of the samples that the latest `process` or `flush` returned.

        Returns
        -------
        ndarray of float32, shape (m,)
            As many samples. Nothing before the first call.

        Examples
        --------
        >>> import numpy as np
        >>> ego = EgoFilter(engine="bypass", output="listen")
        >>> to_listen_to, to_recognise = ego.process(np.zeros(1000), np.zeros(1000)), ego.other()
        >>> to_listen_to.shape == to_recognise.shape
        True
        """
        return self._stream.other

    def robot_removed(self) -> Samples:
        """Each microphone with the robot's voice subtracted, for whoever wants to know where the human is.

        Returns
        -------
        ndarray of float32, shape (n, microphones)
            What came since the last call, whole hops, 30 s at most; sample i of all of them belongs to sample i of the
            input, or is up to 10 ms later while the microphone waits for a late reference. Fan and room are in it.
            Nothing without `keep_channels`, or from an engine without a linear stage.
        """
        return self._stream.robot_removed()

    def announce(self, utterance: Samples) -> None:
        """Say what the robot will play next; it may start at any time, or never, and several queue up.

        Parameters
        ----------
        utterance : ndarray of float, shape (n,)
            The very audio that will be played, whole, at 16 kHz.

        Raises
        ------
        SignalError
            For another shape or dtype, samples that are not finite or beyond 1e6, and where more than 64 utterances
            or five minutes would wait to be heard: then this one is not announced.

        Notes
        -----
        For robots without a loopback: while the reference blocks are zeros, the utterance is looked for in the
        microphone for 30 s, and from about 0.1 s after its first sound on it is the reference. A reference channel that
        carries sound is believed instead, and drops what was announced. The engine paper-ss counts announcements and
        needs none.
        """
        aligner = self._stream.front.aligner
        if aligner and not aligner.announce(as_samples(utterance, "utterance")):
            raise SignalError(
                f"with this more than {MOST_ANNOUNCED} announced utterances or {MOST_ANNOUNCED_S} s of them would wait to be"
                " played: announce an utterance when the one before it begins to play"
            )

    def events(self) -> list[Event]:
        """What happened since the last call.

        Returns
        -------
        list of Event
            Oldest first, at most the latest 1000; see `Event` for the kinds. Ten minutes of turns' sound are kept
            until somebody asks; what is older has lost its sound.
        """
        happened = list(self._stream.events)
        self._stream.events.clear()
        return happened

    def flush(self) -> Samples:
        """End the recording.

        Returns
        -------
        ndarray of float32, shape (m,)
            The rest, so that as many samples are out as went in. After it, `reset` comes before the next `process`.
        """
        return self._stream.flush()

    def reset(self) -> None:
        """Start anew, as after construction."""
        self._stream.reset()

    def __enter__(self) -> EgoFilter:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """End the learner, which then keeps what it is to remember; `with` does it by itself.

        Raises
        ------
        ProfileError
            Where that cannot be written.
        """
        if self._stream.learner:
            self._stream.learner.close()

    def stats(self) -> Stats:
        """State of the path.

        Returns
        -------
        Stats
            Ready for JSON: engine and why, its model, latency, samples, alignment, linear stage, deadlines.
        """
        front = self._stream.front
        model: Model | None = getattr(self._engine, "model", None)
        return {
            "engine": self.engine_name,
            "engine_reason": self.engine_reason,
            "engines": [engine.name for engine in self._engines],
            "output": self._stream.output,
            "model": model.describe() if model else None,
            "latency_ms": None if self.waits_for_end else 1000 * self.latency / SAMPLE_RATE,
            "samples": self._stream.samples_in,
            "alignment": front.aligner.stats() if front.aligner else None,
            "linear_stage": front.linear_stage.stats() if front.linear_stage else None,
            "array": front.microphones.stats() if front.microphones else None,
            "learning": self._stream.learner.stats() if self._stream.learner and front.linear_stage else None,
            "deadline": self._stream.stepping.stats() if self._stream.stepping else None,
        }

    @property
    def can_adapt(self) -> bool:
        """Whether there will be an adapted profile: one to start from and a linear stage that learns."""
        return self.profile is not None and self._stream.front.linear_stage is not None

    def adapted_profile(self) -> Profile:
        """The profile with the echo path as the linear stage has adapted it.

        Returns
        -------
        Profile
            A new one. What of its path is longer than the linear stage is the profile's own, at the volume of now.

        Raises
        ------
        SignalError
            Where `can_adapt` is False.
        """
        profile, stage = self.profile, self._stream.front.linear_stage
        if profile is None or stage is None:
            names = ", ".join(engines.HAVE_LINEAR_STAGE)
            raise SignalError(f"nothing to write back: give a profile and an engine with a linear stage ({names})")
        canceller = stage.canceller
        return profile.with_running_responses(canceller.impulse_response(), canceller.volume.gain, stage.path.effects)


def strongest(profile: Profile | None) -> tuple[Engine | ClipEngine, str]:
    """The best engine that can be made here, and a sentence about it that names those that cannot."""
    missing = ""
    for name in engines.CANDIDATES:
        try:
            return engines.create(name, profile), f"auto: the strongest engine, not measured{missing}"
        except EdgefilterError as error:
            missing += f"; {name} cannot be used: {error}"
    raise UsageError(f"no engine can be made{missing}")


def enhance(
    mic: Samples,
    ref: Samples,
    profile: Profile | str | Path | None = None,
    *,
    engine: str = "auto",
    model: str | Path | None = None,
    learn: Learner | None = None,
    output: SoundFor = "recognise",
    sample_rate: int = SAMPLE_RATE,
) -> Samples:
    """Filter a whole recording with its reference, by the same stream as live.

    Parameters
    ----------
    mic : ndarray of float, shape (n,) or (n, channels)
        What the microphone heard, or two to eight microphones on one clock; full scale +-1.
    ref : ndarray of float, shape (n,)
        What the robot said, on the same sample counter.
    profile, engine, model, learn, output
        As of `EgoFilter`.
    sample_rate : int
        Of both, and of what is returned; the filter works at 16 kHz, so nothing above 8 kHz is left.

    Returns
    -------
    ndarray of float32, shape (n,)
        The human, aligned with the input.

    Raises
    ------
    SignalError, UsageError, ProfileError, ModelError
        As of `EgoFilter.process` and of `EgoFilter`.

    Examples
    --------
    >>> import numpy as np
    >>> robot = 0.1 * np.random.default_rng(0).standard_normal(48_000)
    >>> heard = np.convolve(robot, [0.0] * 500 + [0.5, 0.2])[:48_000]
    >>> left = enhance(heard, robot, engine="linear")[-16_000:]
    >>> bool(np.mean(left**2) < 0.01 * np.mean(heard[-16_000:] ** 2))
    True
    """
    ego = EgoFilter(profile, engine=engine, model=model, learn=learn, output=output)
    human = np.concatenate((ego.process(at_16_khz(mic, sample_rate), at_16_khz(ref, sample_rate)), ego.flush()))
    return from_16_khz(human, sample_rate, len(ref))
