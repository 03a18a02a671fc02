"""Sixteen-bit PCM and its channels: the conversion, and raw sound through pipes (standard input and output)."""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from collections.abc import Iterator, Sequence
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from edgefilter.audio.protocols import Sink, Source
from edgefilter.errors import AudioFileError, SignalError, UsageError
from edgefilter.types import SAMPLE_RATE, Array, Block, Samples, as_samples

FULL_SCALE = -float(np.iinfo(np.int16).min)
_HEADERS = (b"RIFF", b"fLaC", b"OggS")


def to_pcm16(samples: Samples) -> tuple[NDArray[np.int16], int]:
    """Round samples (n,) to 16 bit and return them with the number that did not fit and was saturated.

    Exact for values that came from 16-bit PCM (k / 32768). Raises SignalError for NaN and infinity.
    """
    scaled = np.rint(as_samples(samples, "output") * np.float32(FULL_SCALE))
    fitting = np.clip(scaled, -FULL_SCALE, FULL_SCALE - 1.0)
    return fitting.astype(np.int16), int(np.count_nonzero(fitting != scaled))


def of_pcm16(pcm: bytes | memoryview, channels: int) -> Samples:
    """16-bit little-endian samples, interleaved, as (n, channels) of +-1; SignalError where the last one is cut."""
    if len(pcm) % (2 * channels):
        raise SignalError(f"found {len(pcm)} bytes, expected whole 16-bit samples of {channels} channels")
    return np.frombuffer(pcm, "<i2").reshape(-1, channels).astype(np.float32) / np.float32(FULL_SCALE)


def delivered(data: Array, wanted: Sequence[int] | None) -> Samples:
    """Of data (n, channels) the wanted channels (n, wanted), (n,) where it is one, or the mean of all (n,) where it is None."""
    if wanted is None:
        return data[:, 0] if data.shape[1] == 1 else data.mean(axis=1, dtype=np.float32)
    return data[:, wanted[0]] if len(wanted) == 1 else data[:, wanted]


def clip_note(clipped: int, written: int) -> str:
    """The sentence about saturated samples."""
    return f"{clipped} of {written} output samples exceeded full scale and were clipped: lower the level of the input"


class PcmSource(Source):
    """Raw s16le stereo at 16 kHz, (microphone, reference), from standard input or any binary stream.

    Blocks are as long as the pipe delivers them, so a live pipe is not held up. name: of the stream, in messages.
    Raises AudioFileError for a stream without sound, or with a file's header.
    """

    def __init__(self, stream: BinaryIO | None = None, name: str = "standard input") -> None:
        self._stream = sys.stdin.buffer if stream is None else stream
        self._name = name
        if self._stream.isatty():
            raise UsageError(
                "'-' reads raw s16le 16 kHz stereo (microphone, reference) from a pipe, found a terminal: pipe sound"
                " into it"
            )
        self.notes = []

    def __iter__(self) -> Iterator[Block]:
        start, rest = 0, b""
        for data in self._pieces():
            data = rest + data
            if start == 0 and data.startswith(_HEADERS):
                raise AudioFileError(
                    f"{self._name} begins with the header of an audio file ({data[:4]!r}), expected raw s16le 16 kHz"
                    " stereo (microphone, reference): name the file itself, or leave the header out"
                )
            whole = len(data) // 4 * 4
            rest = data[whole:]
            stereo = of_pcm16(data[:whole], 2)
            if len(stereo):
                yield Block(stereo[:, 0].copy(), stereo[:, 1].copy(), start)
                start += len(stereo)
        if rest:
            cut = f"its last {len(rest)} bytes were ignored (is it s16le stereo?)"
            self.notes.append(f"{self._name} ended in the middle of a sample: {cut}")
        if start == 0 and not self._stopped:
            raise AudioFileError(
                f"{self._name} held no sound, expected raw s16le 16 kHz stereo (microphone, reference): check the program"
                " before the pipe"
            )
        self.total = start

    def _pieces(self) -> Iterator[bytes]:
        """Yield what arrives, as it arrives, until the end or stop()."""
        handle = _handle(self._stream)
        wait = handle is not None and sys.platform != "win32"
        while not self._stopped:
            if handle is not None and wait and not select.select([handle], [], [], 0.1)[0]:
                continue  # and look for stop() while the pipe is silent
            count = io.DEFAULT_BUFFER_SIZE
            data = self._stream.read(count) if handle is None else os.read(handle, count)
            if not data:
                return
            yield data


class PcmSink(Sink):
    """Raw s16le mono at 16 kHz to standard output or any binary stream; a reader that goes away ends it quietly."""

    def __init__(self, stream: BinaryIO | None = None, name: str = "standard output") -> None:
        self._stream = sys.stdout.buffer if stream is None else stream
        self._name = name
        if self._stream.isatty():
            raise UsageError(
                "'-' writes raw s16le 16 kHz mono, found a terminal: pipe it into a program or name a .wav or .flac"
                " file"
            )
        self.notes = []

    def __exit__(self, *exc: object) -> None:
        if self.clipped:
            self.notes.append(clip_note(self.clipped, self.written))

    def write(self, samples: Samples) -> None:
        if self.finished:
            return
        pcm, clipped = to_pcm16(samples)
        try:
            self._write_all(pcm.astype("<i2").tobytes())
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.ECONNRESET):
                raise AudioFileError(f"{self._name} cannot be written: {error.strerror}") from None
            self.finished = True
            self.notes.append(f"the program behind the pipe stopped reading after {self.written / SAMPLE_RATE:.2f} s")
            return
        self.written += pcm.size
        self.clipped += clipped

    def _write_all(self, data: bytes) -> None:
        """Past Python's buffer where there is a file handle: nothing is left in it to fail at exit."""
        handle = _handle(self._stream)
        if handle is None:
            self._stream.write(data)
            return
        while data:
            data = data[os.write(handle, data) :]


def _handle(stream: BinaryIO) -> int | None:
    """The file handle of a stream that has one."""
    try:
        return stream.fileno()
    except (OSError, AttributeError):
        return None
