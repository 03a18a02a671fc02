"""Files as source and sink: a recording with its reference in, a WAV or FLAC out, and all the sound of a run."""

from __future__ import annotations

import errno
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import soundfile

from edgefilter.audio.channels import Channels
from edgefilter.audio.protocols import Sink, Source
from edgefilter.audio.raw import PcmSink, PcmSource, clip_note, to_pcm16
from edgefilter.audio.reader import Reader
from edgefilter.errors import AudioFileError, UsageError
from edgefilter.types import SAMPLE_RATE, Block, Samples, as_microphones

try:
    import fcntl
except ModuleNotFoundError:  # Windows, which does not let two programs write one file anyway
    fcntl = None  # type: ignore[assignment]

_MOST = int(np.iinfo(np.uint32).max)
"""Bytes that a WAV's size fields can say: a longer one says so much, and readers go on to the end of the file."""
_FLAC_FRAME = b"\xff\xf8"  # sync code of a frame of fixed size, RFC 9639, 9.1
MOST_RECORDED = (2**32 - 2**16) // 4
"""Samples of 32 bit that the size field of a WAV file can count: 18.6 hours."""


def open_source(
    path: str | Path,
    reference: str | Path | None = None,
    channels: Channels | None = None,
) -> Source:
    """The source for a recording and its reference; '-', standard input, and named pipes bring both as raw stereo.

    channels: as of FileSource.
    """
    named = Path(path).is_fifo()
    if str(path) != "-" and not named:
        return FileSource(path, reference, channels=channels)
    if channels is not None:
        raise UsageError(
            f"'{path}' as input is stereo, microphone and reference, so its channels cannot be named: give a file or a device, which may have more"
        )
    if reference is not None:
        raise UsageError(
            f"'{path}' as input is stereo and already holds the reference, found a second one, {reference}: leave it out"
        )
    return PcmSource(open(path, "rb", buffering=0), f"input {path}") if named else PcmSource()  # noqa: SIM115


def open_sink(path: str | Path) -> Sink:
    """The sink for a file; '-', standard output, and named pipes get raw samples."""
    if str(path) == "-":
        return PcmSink()
    return PcmSink(open(path, "wb", buffering=0), f"output {path}") if Path(path).is_fifo() else FileSink(path)  # noqa: SIM115


def make_folder(folder: Path, purpose: str) -> None:
    """Make the folder for that purpose if it is not there; raises AudioFileError where it cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AudioFileError(f"folder {folder} for {purpose} cannot be made: {error.strerror}; name another") from None


@contextmanager
def whole(path: str | Path, what: str) -> Iterator[BinaryIO]:
    """A file to write, of which no part is left where the writing fails or is interrupted. what: its kind, which AudioFileError names."""
    try:
        file = open(path, "wb")  # noqa: SIM115
        try:
            with file:
                yield file
        except BaseException:
            written = Path(path).resolve()
            if written.is_file():
                with suppress(OSError):
                    written.unlink()
            raise
    except OSError as error:
        why = f"cannot be written ({error.strerror or error}); name a file in a folder that exists"
        raise AudioFileError(f"{path}: {what} {why}") from None


class FileSource(Source):
    """A recording and, if there is one, the reference of what the robot said, as blocks of 16 kHz mono.

    The recording decides the length: a shorter reference is followed by silence, a longer one is cut, without one the
    reference is silence. `notes` is complete after construction. channels: those of the recording that are
    microphones, in place of the mean of all, and the one that is the reference. Raises AudioFileError for an unusable file (see Reader).
    """

    def __init__(
        self,
        mic_path: str | Path,
        reference_path: str | Path | None = None,
        block: int = 4096,
        channels: Channels | None = None,
    ) -> None:
        self._mic = Reader(mic_path, "recording", channels and replace(channels, reference=None))
        self._reference = None if reference_path is None else Reader(reference_path, "reference")
        if channels is not None and channels.reference is not None:
            self._reference = Reader(mic_path, "reference in", Channels([channels.reference]))
        self.microphones = self._mic.given
        self._block = block
        self.total = self._mic.total
        self.notes = list(self._mic.notes)
        if self._mic.silent:
            self.notes.append(f"recording {mic_path} is silent: every sample is zero")
        if self._reference is None:
            self.notes.append(
                "no reference: nothing tells the robot's voice from the human's; give it with --reference"
            )
        else:
            self.notes += self._reference.notes + _length_notes(self._reference, self._mic.total)

    def __iter__(self) -> Iterator[Block]:
        reference = _Taker(iter(()) if self._reference is None else self._reference.chunks())
        mic = _Taker(self._mic.chunks(), self.microphones)
        for start in range(0, self._mic.total, self._block):
            if self._stopped:
                return
            count = min(self._block, self._mic.total - start)
            yield Block(mic.take(count), reference.take(count), start)


def _length_notes(reference: Reader, total: int) -> list[str]:
    """What there is to say about a reference for a recording of total samples."""
    notes, named = [], f"reference {reference.path} is"
    if reference.silent:
        notes.append(f"{named} silent: every sample is zero, so nothing tells the robot's voice from the human's")
    if difference := abs(reference.total - total):
        how = "shorter than the recording; silence follows it"
        if reference.total > total:
            how = "longer than the recording; its end is not used"
        notes.append(f"{named} {difference} samples ({difference / SAMPLE_RATE:.3f} s) {how}")
    return notes


class _Taker:
    """Chunks of any length in, exactly the asked number of samples out, silence after the last."""

    def __init__(self, chunks: Iterator[Samples], channels: int = 1) -> None:
        self._chunks = chunks
        self._rest = np.zeros(0 if channels == 1 else (0, channels), np.float32)

    def take(self, count: int) -> Samples:
        parts = [self._rest]
        have = len(self._rest)
        while have < count:
            chunk = next(self._chunks, None)
            if chunk is None:
                chunk = np.zeros((count - have, *self._rest.shape[1:]), np.float32)
            parts.append(chunk)
            have += len(chunk)
        joined = np.concatenate(parts)
        self._rest = joined[count:]
        return joined[:count]


class Disk(io.RawIOBase):
    """A file in the making, one program's alone, that stays whole on a full disk and where the program is killed.

    Where an encoder's library would leave a torn last frame behind, a write that does not fit is undone and remembered
    in `error`, and from then on only the header may still be changed.
    Raises BlockingIOError, and leaves the file alone, where another program is writing it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path.resolve()
        # the file as it is: emptied only once it is known that nobody else writes it
        self._file = io.FileIO(path, "r+", opener=lambda name, flags: os.open(name, flags | os.O_CREAT, 0o666))
        if stat.S_ISREG(os.fstat(self._file.fileno()).st_mode):
            _take_alone(self._file)
            self._file.truncate(0)
        self._end: int | None = None
        self._flac_frames = 0
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:  # type: ignore[override]
        at = self._file.tell()
        if self._end is not None and at + len(data) > self._end:
            return len(data)
        try:
            done = 0
            while done < len(data):
                done += self._file.write(data[done:])
        except OSError as error:
            self.error = self.error or error
            self._end = at if self._end is None else self._end
            try:
                self._file.truncate(self._end)
                self._file.seek(self._end)
            except OSError:  # a device, not a file: there is nothing to keep whole
                pass
        else:
            self._flac_frames += data[:2] == _FLAC_FRAME
        return len(data)

    def readinto(self, buffer: bytearray) -> int:  # type: ignore[override]
        return self._file.readinto(buffer)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def update_header(self) -> None:
        """Make the header agree with what is there by now; an encoder does so at the end, which a killed program misses."""
        at = self._file.tell()
        try:
            self._repair_header()
        except OSError as error:
            self.error = self.error or error
        self._file.seek(at)

    def finish(self, sound: bool = True) -> None:
        """Close the file after its encoder; if the disk was full, or the sizes are too large for a header, it is put right.

        sound: whether any was written; a full disk, on which not even the header may have fitted, keeps no file without.
        """
        try:
            if self.error and not sound and self._path.is_file():
                self._path.unlink()
            elif self.error or self._file.seek(0, os.SEEK_END) > _MOST:
                self._repair_header()
            self._file.close()
        except OSError as error:
            self.error = self.error or error
        self.close()

    def _repair_header(self) -> None:
        self._file.seek(0)
        start = self._file.read(io.DEFAULT_BUFFER_SIZE)  # both formats' headers lie within
        if start[:4] == b"fLaC" and len(start) >= 42:
            self._repair_flac(start)
        elif start[:4] == b"RIFF" and b"data" in start:
            end = self._file.seek(0, os.SEEK_END)
            for at in (4, start.index(b"data") + 4):  # RIFF and data chunk: a size counts from behind itself
                self._file.seek(at)
                self._file.write(min(end - at - 4, _MOST).to_bytes(4, "little"))

    def _repair_flac(self, start: bytes) -> None:
        """Put the number of samples that reached the disk into STREAMINFO (RFC 9639, 8.2).

        It starts at byte 8 with the block size, and holds the total in the low 36 bits of bytes 18-25 and the MD5 of
        the sound, zero where unknown, in bytes 26-41. The encoder writes one frame at a time, all but the last full.
        """
        total = self._flac_frames * int.from_bytes(start[8:10], "big")
        fields = int.from_bytes(start[18:26], "big") >> 36 << 36 | total
        self._file.seek(18)
        self._file.write(fields.to_bytes(8, "big") + bytes(16))


def _take_alone(file: io.FileIO) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL):  # file systems without locks
            raise


def form_of(output: Path) -> str:
    """WAV or FLAC, by the suffix; raises UsageError for another one, and for a folder."""
    if output.is_dir():
        raise UsageError(
            f"output {output} is a folder, expected a file: name one in it, such as {output / 'human.wav'}"
        )
    if (form := output.suffix[1:].upper()) not in ("WAV", "FLAC"):
        raise UsageError(f"output {output} ends in '{output.suffix}', expected .wav or .flac: rename it")
    return form


class FileSink(Sink):
    """A 16 kHz file, WAV or FLAC by suffix, 16-bit PCM (or 32-bit float for WAV), mono unless channels are more.

    Valid up to the last sample however the context is left, and where the program is killed: a WAV up to the last
    write, a FLAC up to the last of its frames of a quarter of a second.
    Raises UsageError for another suffix and a folder, AudioFileError where the file cannot be written, another program is writing
    it, or the disk is full; then what fitted remains, as a valid file.

    >>> import tempfile, numpy as np
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with FileSink(f"{folder}/human.wav") as sink:
    ...         sink.write(np.zeros(160, np.float32))
    ...     FileSource(f"{folder}/human.wav").total
    160
    """

    def __init__(self, path: str | Path, float32: bool = False, channels: int = 1) -> None:
        self.path = Path(path)
        self.notes = []
        form = form_of(self.path)
        if self.path.is_fifo():
            raise AudioFileError(
                f"output {self.path} is a pipe, expected a file: only 'run' writes raw samples to a pipe"
            )
        self._float32 = float32
        try:
            self._disk = Disk(self.path)
        except BlockingIOError:
            raise AudioFileError(
                f"output {self.path} is being written by another program (a second edgefilter?): end that one or name"
                " another file"
            ) from None
        except OSError as error:
            raise AudioFileError(
                f"output {self.path} cannot be written: {error.strerror}; name a file in a writable directory"
            ) from None
        try:
            self._file: soundfile.SoundFile | None = soundfile.SoundFile(
                self._disk, "w", SAMPLE_RATE, channels, "FLOAT" if float32 else "PCM_16", format=form
            )
        except soundfile.LibsndfileError as error:
            self._disk.finish(sound=False)
            raise self._full(self._disk.error or OSError(errno.EIO, str(error))) from None
        if self._disk.error:
            self.close()

    def __exit__(self, *exc: object) -> None:
        self.close(quiet=exc[0] is not None)

    def write(self, samples: Samples) -> None:
        if self._float32:
            data: np.ndarray = as_microphones(samples, "output").T
        else:
            data, clipped = to_pcm16(samples)
            self.clipped += clipped
        if self._file is None:
            raise AudioFileError(f"output {self.path} is closed already")
        self._file.write(data)
        if not self._disk.error:
            self._disk.update_header()
        if self._disk.error:
            self.close(quiet=True)
            raise self._full(self._disk.error)
        self.written += len(data)

    def close(self, quiet: bool = False) -> None:
        """Finish the file; a second call does nothing. quiet: another error is under way, a full disk must not cover it."""
        if self._file is None:
            return
        try:
            self._file.close()
        finally:
            self._file = None
            self._disk.finish(self.written > 0)
        if self.clipped:
            self.notes.append(clip_note(self.clipped, self.written))
        if self._disk.error and not quiet:
            raise self._full(self._disk.error)

    def _full(self, error: OSError) -> AudioFileError:
        kept = f"; its first {self.written / SAMPLE_RATE:.1f} s or so are kept" if self.written else ""
        return AudioFileError(
            f"output {self.path} cannot be written on: {error.strerror}{kept}; free some space or write elsewhere"
        )


def write_file(path: str | Path, samples: Samples, float32: bool = False) -> None:
    """Write a whole file of samples, (n,) or (n, channels); float32: as 32-bit float. Raises as FileSink does."""
    with FileSink(path, float32, 1 if samples.ndim == 1 else samples.shape[1]) as sink:
        sink.write(samples)


class Recorder:
    """FOLDER/mic.wav, reference.wav and output.wav, 32-bit float: exactly the samples that the filter got, and those that it gave.

    microphones: channels of mic.wav. A disk that is full ends the recording and not the run: what was written stays
    valid, and the error stands in `failure`. Raises AudioFileError where the folder or a file cannot be made.
    """

    def __init__(self, folder: str | Path, microphones: int) -> None:
        self.folder = Path(folder)
        self.failure: AudioFileError | None = None
        make_folder(self.folder, "the recording")
        self._files: list[FileSink] = []
        try:
            for name, channels in {"mic": microphones, "reference": 1, "output": 1}.items():
                self._files.append(FileSink(self.folder / f"{name}.wav", float32=True, channels=channels))
        except AudioFileError:
            self.__exit__()
            raise

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *exc: object) -> None:
        for file in self._files:
            try:
                file.close()
            except AudioFileError as error:
                self.failure = self.failure or error

    def write(self, block: Block) -> None:
        """Keep a block of the input."""
        self._keep(0, block.mic)
        self._keep(1, block.ref)

    def write_output(self, samples: Samples) -> None:
        """Keep what the filter made, (n,)."""
        self._keep(2, samples)

    def _keep(self, number: int, samples: Samples) -> None:
        if self.failure:
            return
        file = self._files[number]
        try:
            if file.written * samples[:1].size + samples.size > MOST_RECORDED:
                hours = MOST_RECORDED / SAMPLE_RATE / 3600
                raise AudioFileError(
                    f"{file.path} holds {hours:.1f} hours, all that a WAV file can: the recording ends here"
                )
            file.write(samples)
        except AudioFileError as error:
            self.failure = error
            self.__exit__()
