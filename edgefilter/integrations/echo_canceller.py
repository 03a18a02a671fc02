"""EchoCanceller: the filter in the shape of the echo cancellers that programs call now, 10 ms of microphone and reference at a time."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from edgefilter.audio.channels import Channels
from edgefilter.audio.raw import FULL_SCALE, to_pcm16
from edgefilter.dsp.resample import Resampler
from edgefilter.errors import SignalError, UsageError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import as_pcm16
from edgefilter.integrations.wire import DEVICE_RATES
from edgefilter.profile.data import Profile
from edgefilter.types import MOST_MICROPHONES, SAMPLE_RATE, Event, Samples, SoundFor

Sound = TypeVar("Sound", bytes, bytearray, NDArray[np.int16], NDArray[np.floating])
_LOGGER = logging.getLogger(__name__)


class EchoCanceller:
    """An echo canceller as programs call it now: `process(mic, ref)` gives as many samples as came in, of the same type.

    Parameters
    ----------
    sample_rate : int
        Of microphone and reference, 8000 to 48000 Hz.
    channels : int
        Of the microphone's sound, 1 to 8. Each is filtered by itself, which takes its own time.
    profile, engine, output, barge_in : optional
        As of `EgoFilter`.
    mic_channels : sequence of int, optional
        Numbers, from 0, of the channels that are microphones of one array; the answer then is one channel, which
        sounds like the first that is named.

    Attributes
    ----------
    delay : int
        Samples, at `sample_rate`, by which the answer is late: sample i comes out as sample i + delay. Silence comes first.

    Raises
    ------
    UsageError
        For a rate, a number of channels or mic_channels out of range, and an engine that answers only at the end of a recording.

    Notes
    -----
    The filter works at 16 kHz. At other rates the delay grows by 7 ms, and above 16 kHz nothing over 8 kHz survives,
    which a warning in the log says once. One object belongs to one thread at a time.

    Examples
    --------
    >>> import numpy as np
    >>> with EchoCanceller(16000, engine="linear") as canceller:
    ...     out = canceller.process(np.zeros(160, np.int16), np.zeros(160, np.int16))
    ...     out.dtype.name, out.size, canceller.delay
    ('int16', 160, 512)
    """

    def __init__(
        self,
        sample_rate: int = SAMPLE_RATE,
        channels: int = 1,
        *,
        profile: Profile | str | Path | None = None,
        engine: str = "auto",
        mic_channels: Sequence[int] | None = None,
        output: SoundFor = "recognise",
        barge_in: BargeInSettings | None = None,
    ) -> None:
        if sample_rate not in DEVICE_RATES:
            expected = f"{DEVICE_RATES[0]} to {DEVICE_RATES[-1]} Hz: convert the sound before"
            raise UsageError(f"sample_rate is {sample_rate}, expected {expected}")
        if not 1 <= channels <= MOST_MICROPHONES:
            raise UsageError(f"channels is {channels}, expected 1 to {MOST_MICROPHONES}: leave some microphones out")
        array = Channels.named(mic_channels, there=channels)
        self.sample_rate, self.channels = sample_rate, channels
        self._heard = [array] if array else [Channels([number]) for number in range(channels)]
        self._filters = [EgoFilter(profile, engine=engine, output=output, barge_in=barge_in) for _ in self._heard]
        first = self._filters[0]
        if first.waits_for_end:
            why = "needs the whole recording before it answers: take another engine"
            raise UsageError(f"engine {first.engine_name} {why}")
        self._worker: ThreadPoolExecutor | None = None
        if sample_rate > SAMPLE_RATE:
            _LOGGER.warning("at %d Hz nothing above %d Hz survives", sample_rate, SAMPLE_RATE // 2)
        self.reset()

    @classmethod
    def create(
        cls, frame_size: int, filter_length: int, sample_rate: int = SAMPLE_RATE, mics: int = 1, speakers: int = 1
    ) -> EchoCanceller:
        """Make one as speexdsp's Python class is made.

        Parameters
        ----------
        frame_size, filter_length, speakers : int
            Not needed: frames and the reference's channels are as each call has them, the echo path's length is the
            filter's own.
        sample_rate, mics : int
            As `sample_rate` and `channels` of the class.
        """
        return cls(sample_rate, mics)

    def reset(self) -> None:
        """Forget everything; the next sample is the first."""
        rate = self.sample_rate
        for each in self._filters:
            each.reset()
        self._to_filter = [Resampler(rate, SAMPLE_RATE, len(wanted.mics or ())) for wanted in self._heard]
        self._of_ref = Resampler(rate, SAMPLE_RATE)
        self._from_filter = [Resampler(SAMPLE_RATE, rate) for _ in self._heard]
        self.delay = self._filters[0].latency
        if rate != SAMPLE_RATE:
            # delays of both resamplers and the filter, and one sample of rounding for each of the three
            held_s = self._of_ref.delay_s + self.delay / SAMPLE_RATE + self._from_filter[0].delay_s
            self.delay = math.ceil(held_s * rate + 2 * max(rate / SAMPLE_RATE, 1.0))
        self._ready: Samples = np.zeros((len(self._heard), self.delay), np.float32)

    @property
    def delay_ms(self) -> float:
        """The delay in milliseconds."""
        return 1000 * self.delay / self.sample_rate

    @property
    def speaking(self) -> bool:
        """Whether the human is speaking, by the first microphone; always False where the engine does not judge it."""
        return self._filters[0].human_speaks

    @property
    def voice_gain(self) -> float:
        """Gain with which the robot should speak now, as of `EgoFilter`, by the first microphone."""
        return self._filters[0].voice_gain

    @property
    def queued_s(self) -> float:
        """Seconds of speech that the loudspeaker has been handed and has not played yet, as of `EgoFilter`: whoever knows it says so here."""
        return self._filters[0].queued_s

    @queued_s.setter
    def queued_s(self, seconds: float) -> None:
        for each in self._filters:
            each.queued_s = seconds

    def events(self) -> list[Event]:
        """Events of the first microphone since the last call, as of `EgoFilter`; their positions count samples at 16 kHz."""
        return self._filters[0].events()

    def process(self, mic: Sound, ref: Sound) -> Sound:
        """Take the next samples of microphone and reference, and return as many of the human.

        Parameters
        ----------
        mic : ndarray of int16 or float, bytes or bytearray
            (n,), with several microphones (n, channels) or interleaved; float: full scale +-1. Bytes: 16-bit samples,
            interleaved. Never written to.
        ref : the same
            What the loudspeaker plays meanwhile, n samples; of several channels, (n, channels) or interleaved, the mean.

        Returns
        -------
        the type of mic
            In its shape, late by `delay`; of an array one channel, (n,). Integers beyond full scale are clipped.

        Raises
        ------
        SignalError
            For another type or shape, another length of ref, or samples that are not finite.
        """
        given, form = _samples(mic, "mic")
        if not (given.ndim == 1 and given.size % self.channels == 0) and given.shape[1:] != (self.channels,):
            raise SignalError(
                f"mic has shape {given.shape}, expected (n, {self.channels}) or {self.channels} channels interleaved"
            )
        heard = given.reshape(-1, self.channels)
        played, _ = _samples(ref, "ref")
        count = len(heard)
        if played.size % max(count, 1) or played.size < count:
            raise SignalError(
                f"ref has {played.size} samples, expected the {count} of the microphone, or a multiple for several"
                " channels: pad the shorter with zeros"
            )
        if not count:
            return mic
        said = self._of_ref.push(played.reshape(count, -1).mean(axis=1, dtype=np.float32))
        new = []
        for ego, wanted, down, up in zip(self._filters, self._heard, self._to_filter, self._from_filter):
            new.append(up.push(ego.process(down.push(wanted.taken(heard)), said)))
            if ego is not self._filters[0]:
                ego.events()  # `events` tells of the first microphone
        ready = np.concatenate((self._ready, np.stack(new)), axis=1)
        self._ready = ready[:, count:]
        return _like(ready[:, :count].T.reshape(form if len(ready) == self.channels else count), mic)

    async def process_async(self, mic: Sound, ref: Sound) -> Sound:
        """As `process`, in a thread of its own, so that the event loop goes on; calls are served in their order."""
        if self._worker is None:
            self._worker = ThreadPoolExecutor(1, "echo-canceller")
        return await asyncio.get_running_loop().run_in_executor(self._worker, self.process, mic, ref)

    def close(self) -> None:
        """End the thread of `process_async`; `with` and `async with` do it by themselves."""
        if self._worker is not None:
            self._worker.shutdown()
            self._worker = None

    def __enter__(self) -> EchoCanceller:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    async def __aenter__(self) -> EchoCanceller:
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.close()


def _samples(sound: object, name: str) -> tuple[Samples, tuple[int, ...]]:
    """What was given as float32 of full scale +-1, in any shape, and the shape."""
    if isinstance(sound, bytes | bytearray | memoryview):
        if len(sound) % 2:
            raise SignalError(f"{name} has {len(sound)} bytes, expected whole 16-bit samples")
        sound = np.frombuffer(sound, "<i2")
    array = np.asarray(sound)
    if array.dtype == np.int16:
        return array.astype(np.float32) / np.float32(FULL_SCALE), array.shape
    if array.dtype.kind == "f":
        return array.astype(np.float32), array.shape
    raise SignalError(f"{name} has dtype {array.dtype}, expected int16 or float in +-1")


def _like(samples: Samples, given: Sound) -> Sound:
    """Samples in the type of what was given."""
    if isinstance(given, np.ndarray):
        whole = given.dtype.kind != "f"
        return (to_pcm16(samples.ravel())[0].reshape(samples.shape) if whole else samples).astype(given.dtype)
    return type(given)(as_pcm16(samples.ravel()))
