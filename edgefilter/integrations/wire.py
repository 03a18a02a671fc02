"""What a device says to `edgefilter serve`: its first message, and two labelled streams put on one sample counter."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from edgefilter.errors import SignalError
from edgefilter.types import MOST_MICROPHONES, SAMPLE_RATE, Samples, SoundFor, expect_positive

HEADER = struct.Struct("<BxHQ")
"""Before the sound of a message of one of two streams: its label, 0 for the microphone and 1 for the reference, an unused
byte, the number of the message in its stream (from 65535 on to 0), and the counter of its first sample; little-endian."""
DEVICE_RATES = range(8000, 48001)
"""Hz that a device, or a program that calls a canceller, may have: what telephones and sound cards do."""


@dataclass(frozen=True)
class Limits:
    """How much a client of `edgefilter serve` may make the server hold, wait and compute. UsageError where one is not above 0."""

    message: int = 4_000_000
    """Most bytes in a message: an announced utterance of 40 s at 48 kHz; sound usually comes in 20 ms."""
    frames: int = 1000
    """Most frames in a message: the longest message then has frames of `read_at_once` bytes."""
    text: int = 4096
    """Most characters in a JSON message: a hundred times the longest valid one."""
    read_at_once: int = 4096
    """Bytes that are read of a client before others have their turn, 20 ms of two channels at 48 kHz: in frames without
    content, of 6 bytes, these take 5 ms."""
    part_s: float = 0.02
    """Sound that is filtered before other clients have their turn: what a message usually holds."""
    ahead_s: float = 0.1
    """Sound that may come before its time and is filtered at once, five messages. What is ahead of that waits."""
    behind_s: float = 2.0
    """Sound that may come after its time and is filtered at once: what networks hold up."""
    turns: int = 10
    """Of the event loop in which nothing else is done before sound that is ahead has its turn, one client after the other: in five a
    message of 20 ms goes all its way."""
    share: float = 0.5
    """Share of a core that a stream may take. A client whose messages take more of it counts as one that sends sound faster than
    in real time. `crnn` takes 0.1 to 0.3."""
    patience_s: float = 5.0
    """Timeout for the handshake, the first message and the reading of an answer each."""
    idle_s: float = 60.0
    """Timeout for every later message."""
    pings: int = 100
    """Most pings in a row, with no message between them."""
    unread: int = 1 << 16
    """Bytes of answers, those to pings among them, that wait for the client to read them."""
    guests: int = 16
    """Connections that have no stream yet, or none any more; where one more comes, the oldest of them is cut off."""
    jitter_s: float = 0.06
    """How long a missing message is waited for: three of 20 ms."""
    gap_s: float = 10.0
    """Longest gap that is filled with silence; a counter that jumps further is another stream."""
    waiting: int = 64
    """Most messages that wait behind a missing one, or references before any microphone: a good second of 20 ms."""
    waiting_bytes: int = 16_000_000
    """Most bytes that wait in all: a gap of 10 s of eight microphones at 48 kHz, or a reference 83 s ahead of its microphone."""

    def __post_init__(self) -> None:
        expect_positive(asdict(self))


@dataclass(frozen=True)
class Form:
    """A device's first message: how it sends.

    rate: Hz, of the samples and of the counters. streams: "stereo", microphone and reference interleaved, or "two",
    each message of one stream, with a HEADER. microphones: how many, interleaved; in "stereo" they precede the reference.
    codec: "pcm", 16 bit, or "opus", mono, only at 48000 Hz and in "two". late_ms: how long the microphone's sound is held
    back for a late reference. learn: whether to learn the room. bitrate: bits a second of the answer in Opus. output: which
    of the filter's sounds is the answer. ask_db: as in `BargeInSettings`, whole dB. queued_ms: time from when the
    microphone has heard a sound until the loudspeaker plays at the gain that the answer asks for.
    """

    rate: int = SAMPLE_RATE
    streams: Literal["stereo", "two"] = "stereo"
    microphones: int = 1
    codec: Literal["pcm", "opus"] = "pcm"
    late_ms: int = 0
    learn: bool = False
    bitrate: int = 24000
    output: SoundFor = "recognise"
    ask_db: int = 0
    queued_ms: int = 0

    @classmethod
    def of(cls, text: str | bytes) -> Form:
        """Read the first message; raises SignalError, one line, for what it may not hold.

        >>> Form.of('{"rate": 48000}').rate
        48000
        """
        given = message_of(text)
        bounds: dict[str, Any] = {
            "rate": DEVICE_RATES,
            "streams": ("stereo", "two"),
            "microphones": range(1, MOST_MICROPHONES + 1),
            "codec": ("pcm", "opus"),
            "late_ms": range(2001),
            "learn": (False, True),
            "bitrate": range(6000, 128001),
            "output": get_args(SoundFor),
            "ask_db": range(41),
            "queued_ms": range(2001),
        }
        for name, value in given.items():
            allowed = bounds.get(name)
            if allowed is None:
                raise SignalError(f"the first message has '{name}', expected {', '.join(bounds)}")
            if isinstance(value, float) or value not in allowed or isinstance(value, bool) != (name == "learn"):
                between = "to" if isinstance(allowed, range) else "or"
                expected = f"{allowed[0]} {between} {allowed[-1]}"
                raise SignalError(f"the first message has {name} {value!r}, expected {expected}")
        form = cls(**given)
        if form.codec == "opus" and (form.streams != "two" or form.rate != 48000 or form.microphones > 1):
            raise SignalError(
                "codec opus needs two streams, one microphone and a rate of 48000: one packet of both would mix them, and"
                " its clock is always 48 kHz"
            )
        return form


def message_of(text: str | bytes, most: int = Limits.text) -> dict[str, Any]:
    """A message in JSON of so many characters at most; raises SignalError for what is none."""
    try:
        found = json.loads(text) if len(text) <= most else None
    except (ValueError, RecursionError):
        found = None
    if isinstance(text, bytes) or not isinstance(found, dict):
        raise SignalError(
            f"found {text[:40]!r}, expected a text message with an object in JSON of {most} characters at most"
        )
    return found


class _Order:
    """Messages of one stream in the order of their numbers; one that is missing is given up after a while.

    newest: the highest counter so far. bytes: of the sound that waits.
    """

    def __init__(self, jitter: int, most: int) -> None:
        self._jitter, self._most = jitter, most
        self._next: int | None = None
        self._waiting: dict[int, tuple[int, bytes]] = {}
        self.newest = self.bytes = 0

    def push(self, number: int, at: int, sound: bytes) -> Iterator[tuple[int, bytes, bool]]:
        """Take a message and yield all that are now in order: sample counter, sound, and whether messages before it were lost."""
        if self._next is None:
            self._next = number
        ahead = (number - self._next + 32768) % 65536 - 32768
        if ahead < 0 or number in self._waiting:
            return  # given up, or sent twice
        self.newest = max(self.newest, at)
        self._waiting[number] = (at, sound)
        self.bytes += len(sound)
        yield from self._drain(False)
        if self._waiting and self.newest - min(start for start, _ in self._waiting.values()) > self._jitter:
            self._next = min(self._waiting, key=lambda each: (each - (self._next or 0)) % 65536)
            yield from self._drain(True)
        if len(self._waiting) > self._most:
            raise SignalError(
                f"{len(self._waiting)} messages wait for number {self._next} of their stream, expected at most"
                f" {self._most}: number each stream's messages 0, 1, 2, ..., and count its samples without gaps"
            )

    def _drain(self, lost: bool) -> Iterator[tuple[int, bytes, bool]]:
        while self._next in self._waiting:
            at, sound = self._waiting.pop(self._next)
            self._next = (self._next + 1) % 65536
            self.bytes -= len(sound)
            yield at, sound, lost
            lost = False


Decode: TypeAlias = Callable[[bytes], Samples]


class TwoStreams:
    """Microphone and reference with counters of one clock, put together; every sample of the microphone comes out.

    decode_mic, decode_ref: what makes samples of a message's sound, (n,), of an array (n, microphones). The microphone
    waits for its reference, up to late samples of its own. lost: samples for which silence stands in, of the microphone
    and of messages of the reference that never came. late: samples of the reference that came too late, and were left
    out; lateness: by how many samples more than allowed the latest of them was.
    """

    def __init__(self, decode_mic: Decode, decode_ref: Decode, rate: int, late: int, limits: Limits) -> None:
        self._decode_mic, self._decode_ref, self._rate, self._wait = decode_mic, decode_ref, rate, late
        self._limits, jitter = limits, round(limits.jitter_s * rate)
        self._mic_order, self._ref_order = _Order(jitter, limits.waiting), _Order(jitter, limits.waiting)
        self._at: int | None = None
        self._mic, self._ref = decode_mic(b""), np.zeros(0, np.float32)
        self._early: list[tuple[int, Samples]] = []
        self._ref_end = 0
        self.lost = self.late = self.lateness = 0

    def push(self, message: bytes) -> None:
        """Take a message with its header; raises SignalError for one that is none, and where too much waits then."""
        if len(message) < HEADER.size:
            raise SignalError(f"found a message of {len(message)} bytes, expected a header of {HEADER.size} and sound")
        label, number, at = HEADER.unpack_from(message)
        orders = self._mic_order, self._ref_order
        if label >= len(orders):
            raise SignalError(f"found label {label}, expected 0 (microphone) or 1 (reference)")
        for ready in orders[label].push(number, at, message[HEADER.size :]):
            self._take_ref(*ready) if label else self._take_mic(*ready)
        sound = self._mic.nbytes + self._ref.nbytes + sum(part.nbytes for _, part in self._early)
        if (waiting := sound + self._mic_order.bytes + self._ref_order.bytes) > self._limits.waiting_bytes:
            raise SignalError(
                f"{waiting} bytes wait for messages that are missing, expected at most {self._limits.waiting_bytes}: number each"
                " stream's messages 0, 1, 2, ..., and do not send the reference ahead of the microphone"
            )

    def take(self, last: bool = False) -> tuple[Samples, Samples]:
        """What is complete of both, (n,) or (n, microphones), and (n,); last: all."""
        if self._at is None:
            return self._mic, self._ref
        known = max(self._ref_end, self._mic_order.newest - self._wait) - self._at
        count = len(self._mic) if last else min(max(known, 0), len(self._mic))
        mic, self._mic = self._mic[:count], self._mic[count:]
        ref, self._ref = self._ref[:count], self._ref[count:]
        self._at += count
        return mic, np.concatenate((ref, np.zeros(count - ref.size, np.float32)))

    def _take_mic(self, at: int, sound: bytes, lost: bool) -> None:
        samples = self._decode_mic(sound)
        if self._at is None:
            self._at = at
            early, self._early = self._early, []
            for start, part in early:
                self._place(start, part)
        gap = at - self._at - len(self._mic)
        self._check_gap(gap)
        if gap > 0:
            self.lost += gap
            self._mic = np.concatenate((self._mic, np.zeros((gap, *self._mic.shape[1:]), np.float32)))
        self._mic = np.concatenate((self._mic, samples[max(-gap, 0) :]))

    def _take_ref(self, at: int, sound: bytes, lost: bool) -> None:
        samples = self._decode_ref(sound)
        self.lost += max(at - self._ref_end, 0) if lost else 0
        self._ref_end = max(self._ref_end, at + samples.size)
        if self._at is None:
            self._early.append((at, samples))
            del self._early[: -self._limits.waiting]
        else:
            self._place(at, samples)

    def _place(self, at: int, samples: Samples) -> None:
        """Put samples of the reference where they belong; what belongs to samples that are gone is too late."""
        assert self._at is not None
        late = min(max(self._at - at, 0), samples.size)
        if late and samples[:late].any():
            self.late += late
            self.lateness = self._at - at
        at, samples = at + late, samples[late:]
        start = at - self._at
        self._check_gap(start - self._ref.size)
        if start > self._ref.size:
            self._ref = np.concatenate((self._ref, np.zeros(start - self._ref.size, np.float32)))
        known = min(max(self._ref.size - start, 0), samples.size)
        self._ref = np.concatenate((self._ref, samples[known:]))

    def _check_gap(self, gap: int) -> None:
        if abs(gap) > self._limits.gap_s * self._rate:
            raise SignalError(
                f"a counter jumps by {gap / self._rate:.1f} s, expected {self._limits.gap_s:.0f} s at most: begin a new connection"
            )
