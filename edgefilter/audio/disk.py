"""A file that an audio encoder writes into and that is a whole file at any time: on a full disk, and where the program is killed."""

from __future__ import annotations

import errno
import io
import os
import stat
from pathlib import Path

import numpy as np

try:
    import fcntl
except ModuleNotFoundError:  # Windows, which does not let two programs write one file anyway
    fcntl = None  # type: ignore[assignment]

_FLAC_FRAME = b"\xff\xf8"  # sync code of a frame of fixed size, RFC 9639, 9.1
_MOST = int(np.iinfo(np.uint32).max)
"""Bytes that a WAV's size fields can say: a longer one says so much, and readers go on to the end of the file."""


class Disk(io.RawIOBase):
    """A file in the making, one program's alone, that stays whole on a full disk and where the program is killed.

    Where an encoder's library would leave a torn last frame behind, a write that does not fit is undone and remembered
    in `error`, and from then on only the header may still be changed.
    Raises BlockingIOError, and leaves the file alone, where another program is writing it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
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

    def finish(self) -> None:
        """Close the file after its encoder; if the disk was full, or the sizes are too large for a header, it is put right."""
        try:
            if self.error or self._file.seek(0, os.SEEK_END) > _MOST:
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
            self._repair_wav(start)

    def _repair_wav(self, start: bytes) -> None:
        """Put the bytes that reached the disk into the RIFF and the data chunk, whose sizes count from behind themselves."""
        end = self._file.seek(0, os.SEEK_END)
        for at in (4, start.index(b"data") + 4):
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
