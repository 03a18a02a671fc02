"""A filter between a voice agent and its sound: pairs the microphone with what was played meanwhile, and filters.

An agent's two directions share no sample counter. It hands speech over in bursts, faster than it is played, or late,
and drops the rest when it is interrupted. Here the microphone is the clock: speech waits in a queue, and each sample of
the microphone takes one from it, as the loudspeaker does; what the microphone has lost by the clock takes some, too, and is
silence for the filter, which knows then what is still to be heard of it.
Speech that is dropped from the queue was never played and is no reference. The filter's aligner finds how much later the reference is heard.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from edgefilter.audio.channels import Channels
from edgefilter.audio.fade import Fade
from edgefilter.audio.pairing import Pairing
from edgefilter.audio.raw import delivered, of_pcm16, to_pcm16
from edgefilter.audio.sample_clock import Lateness, SampleClock
from edgefilter.dsp.resample import Resampler
from edgefilter.errors import UsageError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.turns import WAITING_S, drop_sound
from edgefilter.types import MOST_MICROPHONES, SAMPLE_RATE, SET_UP_WRONG, Event, Samples, as_microphones

MOST_QUEUED_S = WAITING_S
"""Speech that may wait to be played, as much as turns may wait: longer than any answer. The rest is refused and counted."""
WAITED_S = 1e-3
"""Least gap between two calls, in seconds, that shows that the caller has no backlog; one that is behind calls again at once."""
FILLED_S = 1.0
"""Most of it that is filled with silence at once, which takes 0.1 to 0.3 s to compute: more than rooms and buffers hold back."""
PATIENCE_S = 0.12
"""How long the microphone waits for late speech: three times the 40 ms that a Pipecat transport hands over at once."""
PACE_S, PACE_NEAR = 5.0, 0.01
"""Seconds over which samples are counted, and by how much two counts may differ from one another and from a factor of
CONFUSED: some callbacks of 20 ms."""
CONFUSED = (1 / 6, 1 / 3, 1 / 2, 2 / 3, 44.1 / 48, 48 / 44.1, 3 / 2, 2.0, 44.1 / 16, 3.0, 4.0, 6.0)
"""By what factor more samples come than the rate that is said promises, where it is taken for another one (of a sound card, a telephone, a
recogniser), or two or four channels are taken for one."""
_LOGGER = logging.getLogger(__name__)


class Duplex:
    """An EgoFilter between an agent's microphone and its loudspeaker, for frames of any length and rate.

    `play` and what changes the queue may be called from any thread, `hear` from one at a time.

    Parameters
    ----------
    ego : EgoFilter, optional
        The filter; by default one without a profile, which always judges speech.
    patience_s : float
        How long the microphone waits for late speech while the robot talks: a gap in the reference that the loudspeaker
        did not make costs an alignment. 0 for agents that hand speech over early.
    on_event : callable, optional
        Called with each `Event`, in the thread of `hear`. Without it the latest thousand are kept for `events()`.
    clock : callable
        Seconds, monotonic.
    mic_channels : sequence of int or Channels, optional
        Numbers, from 0, of the channels that are microphones, one to eight; the answer sounds like the first named.
        Without it `hear` takes all channels for microphones, and `hear_pcm16`, which gets what a device brings, their mean.
    reference_channel : int, optional
        Number, beside mic_channels, of the channel that holds what is played, for devices that record it. It is the
        reference, on the microphones' own clock; what `play` takes is then only counted.

    Attributes
    ----------
    heard : int
        Samples of the microphone so far, at 16 kHz, by which events and turns are counted; lost ones that silence stands in for
        are among them.
    listeners : list of callable
        Called with each `Event` beside on_event, in the thread of `hear`.
    enabled : bool
        False passes the microphone on as it is; the filter goes on, so that its events stay true.

    Raises
    ------
    UsageError
        For an engine that answers only at the end of a recording, and for channels that cannot be meant.

    Notes
    -----
    A warning is logged when an engine is at work that judges no speech, from which no events of speech come, and for
    each event of a kind in `types.SET_UP_WRONG`.

    Examples
    --------
    >>> import numpy as np
    >>> duplex = Duplex(EgoFilter(engine="linear"))
    >>> duplex.play(np.zeros(24_000, np.float32), 24_000)  # a second of speech at once
    >>> sum(duplex.hear(np.zeros(480, np.float32), 48_000).size for _ in range(50)) > 20_000
    True
    """

    def __init__(
        self,
        ego: EgoFilter | None = None,
        patience_s: float = PATIENCE_S,
        on_event: Callable[[Event], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
        mic_channels: Sequence[int] | Channels | None = None,
        reference_channel: int | None = None,
    ) -> None:
        self._wanted = Channels.named(mic_channels, reference_channel)
        self._both = self._wanted is not None and self._wanted.reference is not None
        self.listeners: list[Callable[[Event], object]] = []
        self.ego = EgoFilter(barge_in=BargeInSettings(judge="network")) if ego is None else ego
        if self.ego.waits_for_end:
            raise UsageError(
                f"engine {self.ego.engine_name} needs the whole recording before it answers: an agent needs another"
            )
        self._patience = 0 if self._both else round(patience_s * SAMPLE_RATE)
        self._on_event, self._clock = on_event, clock
        self._queue_lock, self._hear_lock = threading.Lock(), threading.Lock()
        self._pairing = Pairing(late_is_lost=False)
        self._gaps = self._refused = self.heard = 0
        self._from_agent = Resampler(SAMPLE_RATE, SAMPLE_RATE)
        self._from_mic, self._to_agent = (Resampler(SAMPLE_RATE, SAMPLE_RATE) for _ in range(2))
        self._pace, self._asked = Pace(clock), Fade()
        self._losses, self._delivered_s, self._timed = SampleClock(), 0.0, False
        self._unheard, self._came = np.zeros(0, np.float32), np.zeros(0, bool)
        self._kept: deque[Event] = deque(maxlen=1000)
        self.enabled = True
        self._talking = self._paused = self._held = self._deaf = self._averaged = False
        self._talking_since = self._left_at = clock()

    def play(self, samples: Samples, rate: int) -> None:
        """Take speech that is handed to the loudspeaker, to be played after all that was before it.

        samples: one channel of float, full scale +-1, (n,) or (n, 1), at rate. Raises SignalError as `EgoFilter.process` does.
        """
        speech = as_microphones(samples, "speech", most=1)
        with self._queue_lock:
            if not self._talking:
                self._talking, self._talking_since = True, self._clock()
            if self._from_agent.rates[0] != rate:
                self._finish()
                self._from_agent = Resampler(rate, SAMPLE_RATE)
            self._append(self._from_agent.push(speech))

    def play_pcm16(self, pcm: bytes | memoryview, rate: int, channels: int = 1) -> None:
        """As `play`, for 16-bit samples, interleaved."""
        self.play(from_pcm16(pcm, channels), rate)

    def lowered(self, samples: Samples, rate: int) -> Samples:
        """Return what to hand to the loudspeaker, and to `play`: the samples (n,) or (n, channels), softer where the filter asks for it.

        The filter asks while somebody is suspected to speak (`BargeInSettings.ask_db`, `EgoFilter.voice_gain`). rate: Hz.
        """
        self._asked.wanted = self.ego.voice_gain
        return self._asked.apply(samples, rate)

    def lowered_pcm16(self, pcm: bytes | memoryview, rate: int, channels: int = 1) -> bytes | memoryview:
        """As `lowered`, for 16-bit samples, interleaved."""
        samples = of_pcm16(pcm, channels)
        softer = self.lowered(samples, rate)
        return pcm if softer is samples else to_pcm16(softer.ravel())[0].astype("<i2").tobytes()

    def end(self) -> None:
        """Take the utterance for complete: the microphone does not wait for more of it."""
        with self._queue_lock:
            self._finish()
            self._talking = False

    def interrupt(self) -> None:
        """Drop the speech that has not been played: the robot fell silent in mid-word."""
        with self._queue_lock:
            self._from_agent = Resampler(*self._from_agent.rates)
            self._pairing.drop(self._pairing.queued)
            self._talking = False

    def pause(self) -> None:
        """Hold the speech that waits: the loudspeaker stands still."""
        self._paused = True

    def resume(self, skipped_s: float = 0.0) -> None:
        """Go on after a pause; skipped_s: how much of the speech that waits the loudspeaker leaves out."""
        with self._queue_lock:
            self._pairing.drop(round(skipped_s * SAMPLE_RATE))
            self._paused = False

    def hear(self, samples: Samples, rate: int, at_s: float | None = None) -> Samples:
        """Take the microphone's next samples and return the human's samples that are ready, (m,), at the same rate.

        samples: float, full scale +-1, (n,), or (n, channels) of a microphone array, the same number of channels in every
        call. at_s: when the first of them was recorded, seconds of the sender's clock; give it if it is known, since samples
        that were lost on the way are then noticed at once. One call may return no samples, or more than it was given; all
        calls together return as many as came in, delayed by the filter's latency and, at rates other than 16 kHz, by 3.5 ms
        for each of the two resamplers. Raises SignalError as `EgoFilter.process` does.
        """
        if self._wanted is not None:
            samples = self._wanted.taken(np.reshape(samples, (len(samples), -1)))
        samples = np.ascontiguousarray(as_microphones(samples, "mic", MOST_MICROPHONES + self._both).T)
        with self._hear_lock:
            channels = 1 if samples.ndim == 1 else samples.shape[1]
            if self._from_mic.rates[0] != rate or self._from_mic.channels != channels:
                self._from_mic, self._to_agent = Resampler(rate, SAMPLE_RATE, channels), Resampler(SAMPLE_RATE, rate)
            with self._queue_lock:
                self._pairing.hear(self._from_mic.push(samples))
                self._follow_losses(len(samples) / rate, at_s)
                mic, reference = self._paired()
                self.ego.queued_s = self.queued_s
            if self._both:
                mic, reference = mic[:, :-1], mic[:, -1]
            human = self._filter(mic, reference)
            if human.size:
                self._warn_if_deaf()
            human = self._to_agent.push(human)
            events = self.ego.events()
            if wrong := self._pace.note(len(samples), rate):
                events.append(Event("rate_mismatch", self.heard, wrong))
            self._left_at = self._clock()
        for event in events:
            if event.kind in SET_UP_WRONG:
                _LOGGER.warning("%s: %s", event.kind.replace("_", " "), event.detail)
            for tell in (self._on_event or self._keep, *self.listeners):
                tell(event)
        if self.enabled:
            return human
        return samples if samples.ndim == 1 else samples[:, 0]

    def events(self) -> list[Event]:
        """Events since the last call, oldest first, unless on_event takes them; their `turn` is as in `EgoFilter.events`."""
        with self._queue_lock:
            return [self._kept.popleft() for _ in range(len(self._kept))]

    def _keep(self, event: Event) -> None:
        with self._queue_lock:
            self._kept.append(event)
            if event.turn is not None:
                drop_sound(self._kept)

    def hear_pcm16(
        self,
        pcm: bytes | memoryview,
        rate: int,
        channels: int = 1,
        answers: int | None = None,
        at_s: float | None = None,
    ) -> bytes:
        """As `hear`, for 16-bit samples, interleaved; answers: channels of the answer, each of them the human, None: as came in."""
        if channels > 1 and self._wanted is None and not self._averaged:
            self._averaged = True
            _LOGGER.warning(
                "%d channels averaged to one: if they are a microphone array, give the numbers of its channels (mic_channels)",
                channels,
            )
        samples = from_pcm16(pcm, channels) if self._wanted is None else of_pcm16(pcm, channels)
        return as_pcm16(self.hear(samples, rate, at_s), answers or channels)

    def require_judge(self, what: str) -> None:
        """Raise UsageError where an engine of the filter judges no speech: what would never notice the human."""
        if not self.ego.judges_speech:
            raise UsageError(
                f"{what} got a filter whose engines ({', '.join(self.ego.stats()['engines'])}) do not all judge speech,"
                " so that the human would not be noticed: leave out budget_ms, or give EgoFilter"
                " barge_in=BargeInSettings(judge='network')"
            )

    @property
    def queued_s(self) -> float:
        """Seconds of speech that wait to be played."""
        return self._pairing.queued / SAMPLE_RATE

    def stats(self) -> dict[str, float]:
        """Seconds of speech: played_s, queued_s, dropped_s, unheard_s (the microphone was off), refused_s; and gaps.

        gaps: how often speech ran out, at its end unless the agent calls `end`, or within it.
        """
        now = self._pairing
        counts = {"played": now.played, "dropped": now.dropped, "unheard": now.skipped, "refused": self._refused}
        seconds = {f"{what}_s": count / SAMPLE_RATE for what, count in counts.items()}
        return {**seconds, "queued_s": self.queued_s, "gaps": self._gaps}

    def close(self) -> None:
        """End the filter's learner, if it has one."""
        self.ego.close()

    def _filter(self, mic: Samples, reference: Samples) -> Samples:
        """What the filter answers to samples of the microphone; silence stands in before them where some were lost."""
        lost, self._unheard = self._unheard, self._unheard[:0]
        came = np.ones(lost.size + len(mic), bool)
        came[: lost.size] = False
        self.heard += came.size
        self._came = np.concatenate((self._came, came))
        silence = np.zeros((lost.size, *mic.shape[1:]), np.float32)
        human = self.ego.process(np.concatenate((silence, mic)), np.concatenate((lost, reference)))
        came, self._came = self._came[: human.size], self._came[human.size :]
        return human[came]

    def _warn_if_deaf(self) -> None:
        """Log once, each time it begins, that the engine at work judges no speech, and once that one does again."""
        deaf, self._deaf = self._deaf, self.ego.speech_probability is None
        if self._deaf and not deaf:
            _LOGGER.warning(
                "engine %s detects no speech: the human is not noticed. With EgoFilter(barge_in=BargeInSettings(judge="
                "'network')) every engine notices one",
                self.ego.engine_name,
            )
        elif deaf and not self._deaf:
            _LOGGER.warning("engine %s detects speech: from now on the human is noticed again", self.ego.engine_name)

    def _paired(self) -> tuple[Samples, Samples]:
        """The samples of the microphone that need not wait, and what was played while they were recorded."""
        pairing, count = self._pairing, len(self._pairing.mic)
        if self._paused:
            mic, pairing.mic = pairing.mic, pairing.mic[:0]
            return mic, np.zeros(count, np.float32)
        if self._held:
            count = 0
        elif self._talking and count > pairing.queued:
            if count - pairing.queued <= self._patience:
                count = pairing.queued
            else:
                self._finish()
                self._talking = False
                self._gaps += 1
        return pairing.pair(count)

    def _follow_losses(self, heard_s: float, at_s: float | None) -> None:
        """Skip what was played while the microphone's sound was lost, and take it back where that comes after all.

        A reference that is early after a wrong guess is found by the aligner; a late one could not be.
        """
        now = self._clock()
        self._delivered_s += heard_s
        waited = now - self._left_at >= WAITED_S
        self._held = False
        if self._paused or (at_s is not None) != self._timed:
            self._timed = at_s is not None
            self._losses = SampleClock(Lateness(look_s=0.0)) if self._timed else SampleClock()
        elif waited or at_s is not None:
            lost_s = self._losses.note(self._delivered_s, now if at_s is None else at_s + heard_s)
            self._held = self._talking and self._losses.doubts
            if lost_s > 0.0:
                count = round(min(lost_s, max(now - self._talking_since, 0.0)) * SAMPLE_RATE)
                skipped = self._pairing.skip(min(count, self._pairing.queued))[-round(FILLED_S * SAMPLE_RATE) :]
                self._unheard = skipped[:0] if self._both else skipped
            elif lost_s < 0.0:
                self._pairing.put_back(round(-lost_s * SAMPLE_RATE))

    def _append(self, samples: Samples) -> None:
        fits = samples[: max(0, round(MOST_QUEUED_S * SAMPLE_RATE) - self._pairing.queued)]
        self._refused += samples.size - fits.size
        self._pairing.play(fits)

    def _finish(self) -> None:
        """Queue what the resampler holds back; speech that follows begins a new stream."""
        self._append(self._from_agent.push(np.zeros(0, np.float32), last=True))
        self._from_agent = Resampler(*self._from_agent.rates)


class Pace:
    """Tells a wrong sample rate, whose sound comes too fast or slow by one of a few factors, from a busy machine, where it may be any.

    >>> now = iter(range(100))
    >>> pace = Pace(lambda: float(next(now)))
    >>> [said for said in (pace.note(32000, 16000) for _ in range(20)) if said]
    ['it brings 32000 samples a second and is said to have 16000: give the rate and the number of channels that it really has']
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._began: float | None = None
        self._came, self._before, self._said = 0, 0.0, 0.0

    def note(self, samples: int, rate: int) -> str:
        """Take note of samples that have come; what is wrong, once, else nothing."""
        now = self._clock()
        if self._began is None:
            self._began = now  # the first samples were recorded before
            return ""
        self._came += samples
        if now - self._began < PACE_S:
            return ""
        found, before = self._came / (now - self._began), self._before
        self._began, self._came, self._before = now, 0, found
        wrong = abs(found / before - 1) < PACE_NEAR if before else False
        factor = next((each for each in CONFUSED if abs(found / rate / each - 1) < PACE_NEAR), 1.0)
        if not wrong or factor in (1.0, self._said):
            return ""
        self._said = factor
        brings = f"it brings {factor * rate:.0f} samples a second and is said to have {rate}"
        return f"{brings}: give the rate and the number of channels that it really has"


def from_pcm16(pcm: bytes | memoryview, channels: int = 1) -> Samples:
    """16-bit little-endian samples, interleaved, as one channel (n,) of +-1: their mean."""
    return delivered(of_pcm16(pcm, channels), None)


def as_pcm16(samples: Samples, channels: int = 1) -> bytes:
    """One channel (n,) as 16-bit little-endian samples, each repeated in all channels."""
    pcm = to_pcm16(samples)[0].astype("<i2")
    return pcm.tobytes() if channels == 1 else np.repeat(pcm, channels).tobytes()
