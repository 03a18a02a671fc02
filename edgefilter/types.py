"""What flows along the data path: blocks of samples from a source, frames of spectra to an engine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias, TypedDict, get_args

import numpy as np
from numpy.typing import NDArray

from edgefilter.errors import SignalError, UsageError

SAMPLE_RATE = 16000
"""Samples per second of everything inside; sources convert at the door."""
PRE_ROLL = 64
"""Samples (4 ms) of the impulse response before the direct sound: what equalisers and linear-phase filters of a
loudspeaker ring ahead of it."""
MOST_MICROPHONES = 8
LOUDEST = 1e6
"""Largest sample that is taken, 120 dB over full scale: no recording is louder, and powers stay within float32."""

Array: TypeAlias = NDArray[np.floating]
Samples: TypeAlias = NDArray[np.float32]
Spectrum: TypeAlias = NDArray[np.complex64]


@dataclass(frozen=True, slots=True)
class Block:
    """Samples of both channels that belong to the same stretch of the sample counter.

    mic: (n,) float32, full scale +-1, any n >= 0; of an array (n, channels). ref: (n,). start: counter of the first
    sample. lost: samples that the source could not deliver since the previous block (silence is in their place).
    """

    mic: Samples
    ref: Samples
    start: int
    lost: int = 0


class Frame(NamedTuple):
    """One STFT frame as an engine sees it; a tuple, as all that is made once a hop: a frozen dataclass takes twice as long to make.

    mic, reference, echo, error: (bins,) complex64. reference is delayed to where the robot's voice arrives at the
    microphone, echo is the linear stage's estimate of it, error = mic - echo. noise_psd, residual_psd: (bins,) float32,
    expected |spectrum|^2 of the noise and of the residual echo in error. idle: nothing of the robot can be audible.
    at_any_lag: the robot may be audible at a lag that nobody knows, so that nothing tells its voice from a human's.
    """

    mic: Spectrum
    reference: Spectrum
    echo: Spectrum
    error: Spectrum
    noise_psd: Samples
    residual_psd: Samples
    idle: bool = False
    at_any_lag: bool = False


class Output(NamedTuple):
    """An engine's answer: the human's spectrum (bins,) complex64 and, if it judges that, whether a human speaks (0-1).

    recognise: spectrum of the sound for a recogniser; None where that is the same.
    """

    spectrum: Spectrum
    speech_probability: float | None = None
    recognise: Spectrum | None = None

    @property
    def sounds(self) -> Spectrum:
        """Spectra (2, bins): to recognise, to listen to."""
        return np.stack((self.spectrum if self.recognise is None else self.recognise, self.spectrum))


_Speech: TypeAlias = Literal["speech_suspected", "speech_dismissed", "speech_started", "speech_stopped", "voice_gain"]
_Filter: TypeAlias = Literal["realigned", "overloaded", "stepped_down", "stepped_up", "learned", "unlearned"]
_SetUp: TypeAlias = Literal[
    "reference_missing",
    "reference_late",
    "reference_gaps",
    "robot_unfound",
    "echo_unpredicted",
    "same_signal",
    "rate_mismatch",
]
_Device: TypeAlias = Literal["lost", "overrun", "underrun", "device_gone", "device_back"]
EventKind: TypeAlias = Literal[_Speech, _Filter, _SetUp, _Device]

SET_UP_WRONG: tuple[EventKind, ...] = get_args(_SetUp)
"""Kinds of event that report a wrong connection, one event each time that one begins."""


class Turn(NamedTuple):
    """What the human said, from half a second before they were noticed until they had finished, 30 s at most; or a part of it.

    start: the first sample, of the microphone. samples: (n,) float32; of an array filtered once more with what is known
    at the end, with one microphone what was streamed.
    """

    start: int
    samples: Samples


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a user of the stream may want to know.

    Parameters
    ----------
    kind : str
        What happened. "realigned": the reference was found elsewhere in the microphone. "speech_started",
        "speech_stopped": of the human, from engines that judge it; "speech_suspected", some hops before most beginnings,
        which "speech_dismissed" takes back where nobody spoke; "voice_gain", with which gain (its detail) the robot
        should speak until the next such event, so that what is heard tells whether it was the robot
        (`BargeInSettings.ask_db`). "overloaded", "stepped_down", "stepped_up": what too little or enough time led to.
        "learned", "unlearned": a better echo path was taken over, or given back.
        "reference_missing", "reference_late", "robot_unfound": the reference was silent from the start or fell silent while
        the robot is heard, comes after its echo, or carries sound that is not found in the microphone, though that
        hears something then. "echo_unpredicted": the echo is found, and hardly any of it can be subtracted. "same_signal": the
        microphone is the reference. "rate_mismatch": a plugin's or a service's sound comes at another pace than its rate and
        channels say, or the loudspeaker plays at another one. "reference_gaps": the reference loses samples. Only from
        `edgefilter run`: "lost", "overrun", "underrun" (samples that the sound devices lost, callbacks that came too late),
        "device_gone", "device_back" (a device stopped, so that silence stands in for it, and runs again).
    sample : int
        By which sample of the microphone, in whole hops.
    detail : str
        The same in words, with figures.
    turn : Turn, optional
        Of "speech_stopped": what the human said, for a recogniser that takes a turn as a whole; dropped after some time
        where nobody asks for the event.
    sound : Turn, optional
        Of "speech_started" and "speech_stopped": from at least 300 ms before speech was suspected, or had stopped, until then,
        at 16 kHz, without the robot, for a classifier of turns or backchannels; at the start of a recording there is less.
    """

    kind: EventKind
    sample: int
    detail: str
    turn: Turn | None = field(default=None, compare=False, repr=False)
    sound: Turn | None = field(default=None, compare=False, repr=False)


SoundFor: TypeAlias = Literal["recognise", "listen"]
"""For whom the human's sound is: a recogniser, or somebody in a call, a level meter, a detector of speech."""

AlignmentState: TypeAlias = Literal["idle", "announced", "begun", "unfound", "coarse", "lost", "locked"]
"""What is known of the utterance that may be heard now (edgefilter.alignment.aligner.Aligned)."""


class AlignmentCounts(TypedDict, total=False):
    """What the tracking aligner did so far, as often as it did it."""

    utterances: int
    realignments: int
    jumps: int
    searches: int
    announced: int
    announced_heard: int


class AlignmentStats(AlignmentCounts, total=False):
    """What the aligner found.

    Method "tracking" has all keys but utterances_aligned; "paper" has method, delay_samples, confidence and
    utterances_aligned. probability: that the delay is right, 0 to 1; deviation_samples: the standard deviation of a delay
    that is right. confidence: with "tracking" the same as probability, its earlier name; with "paper" a correlation.
    """

    method: Literal["tracking", "paper"]
    state: AlignmentState
    delay_samples: float | None
    deviation_samples: float | None
    probability: float
    confidence: float
    ppm: float
    utterances_aligned: int


class CancellerStats(TypedDict):
    """What the canceller did: hops, those in which it adapted, its length in hops, the playback gain that it follows.

    diverged: how often it began anew because what it predicted was beyond all reason.
    """

    hops: int
    active_hops: int
    partitions: int
    gain_db: float
    diverged: int


class LinearStageStats(CancellerStats):
    """What the linear stage did. removed_db: by how much it lowers the robot now, dB, by the last 5 s of robot; None before 3 s."""

    removed_db: float | None


class DeadlineStats(TypedDict):
    """Compute per hop, and what came of it; compute: mean_ms, p50_ms, p95_ms, p99_ms, max_ms."""

    hop_ms: float
    budget_ms: float
    hops: int
    missed_deadlines: int
    over_budget: int
    most_behind_ms: float
    steps: int
    compute: dict[str, float]


class ArrayStats(TypedDict):
    """Of an array: how many microphones, the one that the answer sounds like, and why others are left out, by number."""

    microphones: int
    reference: int
    left_out: dict[str, str]


class Stats(TypedDict):
    """What EgoFilter.stats() returns, ready for JSON.

    engine, engine_reason: the one at work, and why it was chosen. engines: those that can take turns. output: which sound
    process returns. model: what a network's file says of itself, None without one. latency_ms: algorithmic, None for an
    engine that needs the whole recording. samples: taken in so far. alignment, linear_stage: None for engines that go
    without. array: None with one microphone. learning: what the learner did, None without one.
    """

    engine: str
    engine_reason: str
    engines: list[str]
    output: SoundFor
    model: dict[str, object] | None
    latency_ms: float | None
    samples: int
    alignment: AlignmentStats | None
    linear_stage: LinearStageStats | None
    array: ArrayStats | None
    learning: dict[str, object] | None
    deadline: DeadlineStats | None


def expect_positive(fields: Mapping[str, object]) -> None:
    """Raise UsageError for the first of these fields, by name, whose number, or one of whose numbers, is not above 0."""
    for name, value in fields.items():
        if not np.min(np.asarray(value)) > 0:
            raise UsageError(f"{name} is {value}, expected more than 0")


def as_samples(x: object, name: str) -> Samples:
    """Return x as an (n,) float32 array, contiguous, without writing into it.

    Raises SignalError for another shape or dtype, and for samples that are not finite or louder than LOUDEST.
    """
    array = np.asarray(x)
    if array.dtype.kind != "f":
        how = "divide integer PCM by its full scale"
        # bytes in place of an array, as sounddevice's raw streams hand them over
        if array.dtype.itemsize == 1 or array.dtype.kind == "S":
            how = (
                "of bytes make samples first, numpy.frombuffer(buffer, numpy.float32), or numpy.int16 and then / 32768"
            )
        raise SignalError(f"{name} has dtype {array.dtype}, expected float samples in +-1: {how}")
    if array.ndim != 1:
        raise SignalError(f"{name} has shape {array.shape}, expected one channel of shape (n,)")
    array = np.ascontiguousarray(array, np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        power = array.dot(array)
    if not power < LOUDEST**2:  # what is below it as a whole is so in every sample, and this is cheap
        good = np.abs(array) <= LOUDEST
        if not good.all():
            bad = int(np.argmin(good))
            expected = "samples of a full scale of 1: its scaling is wrong"
            if not math.isfinite(array[bad]):
                expected = "finite samples: repair or cut the recording"
            raise SignalError(f"{name} holds {array[bad]:g} at sample {bad}, expected {expected}")
    return array


def as_microphones(x: object, name: str, most: int = MOST_MICROPHONES) -> Samples:
    """Return x (n,) or (n, channels) as (n,) float32 where it has one channel, else as (channels, n), contiguous.

    Raises SignalError for more than most channels, and as as_samples does.
    """
    array = np.asarray(x)
    if array.ndim != 2:
        return as_samples(array, name)
    if not 1 <= array.shape[1] <= most:
        raise SignalError(f"{name} has shape {array.shape}, expected (n,) or (n, channels) with 1 to {most} channels")
    if array.shape[1] == 1:
        return as_samples(array[:, 0], name)
    return np.stack([as_samples(channel, f"{name}, channel {at},") for at, channel in enumerate(array.T)])
