"""One audio file as a stream of 16 kHz mono samples; everything that can be wrong with the file is found at opening."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import soundfile
import soxr

from edgefilter.audio.channels import Channels
from edgefilter.audio.raw import delivered
from edgefilter.dsp.resample import RATES
from edgefilter.errors import AudioFileError
from edgefilter.types import LOUDEST, SAMPLE_RATE, Array, Samples

OTHER_FORMS = {
    b"ftyp": "an MPEG-4 file (m4a, mp4)",
    b"\x1aE\xdf\xa3": "a Matroska file (webm, mkv)",
    b"\xff\xf1": "an AAC file",
    b"\xff\xf9": "an AAC file",
    b"#!AMR": "an AMR file",
    b"0&\xb2u": "a Windows Media file (wma)",
}
"""What telephones and browsers record that libsndfile does not read, by its first bytes, in MPEG-4 the fifth to eighth."""
_ENDLESS = 0x7FFFF000
"""Writers to a pipe put sizes from here up into a WAV's header because they cannot know better."""


class Reader:
    """A WAV, FLAC or Ogg file of any rate and channel count, delivered at 16 kHz with its channels averaged.

    channels: those to be delivered in that order in place of their mean.
    role: how messages name the file ("recording"). The file is read once at opening, so that a damaged one is refused
    before anything is made from it. total: round(n * 16000 / rate) samples. given: channels that are delivered. silent:
    every sample is zero.
    Raises AudioFileError for a file that is missing, empty, truncated, not audio, or holds what no recording does.
    """

    def __init__(self, path: str | Path, role: str = "recording", channels: Channels | None = None) -> None:
        self.path = Path(path)
        self.role = role
        self.notes: list[str] = []
        self.silent = True
        self._check_is_file()
        with self._open() as file:
            self.rate, self.channels = file.samplerate, file.channels
            self._check_header(file)
            self.wanted = None if channels is None else channels.among(self.channels, f"{role} {path}", AudioFileError)
            self.given = len(self.wanted) if self.wanted else 1
            length = self._scan(file)
        self.total = (2 * length * SAMPLE_RATE + self.rate) // (2 * self.rate)
        if self.total == 0:
            raise self._error(
                f"holds {length} samples at {self.rate} Hz, expected at least one at {SAMPLE_RATE} Hz: record it again"
            )
        self._note_conversion()

    def chunks(self) -> Iterator[Samples]:
        """Yield float32 arrays (n,), or (n, channels) of several that are wanted, of any length, `total` samples in all."""
        resampler = soxr.ResampleStream(self.rate, SAMPLE_RATE, self.given, dtype="float32", quality="VHQ")
        given = 0
        with self._open() as file:
            for data in self._blocks(file):
                taken = delivered(data, self.wanted)
                if self.rate != SAMPLE_RATE:
                    taken = resampler.resample_chunk(np.ascontiguousarray(taken))
                given += len(taken)
                yield taken
        if self.rate != SAMPLE_RATE:
            rest = np.zeros((0, self.given) if self.given > 1 else 0, np.float32)
            yield resampler.resample_chunk(rest, last=True)[: self.total - given]

    def _error(self, what: str) -> AudioFileError:
        return AudioFileError(f"{self.role} {self.path} {what}")

    def _check_is_file(self) -> None:
        if self.path.is_dir():
            raise self._error("is a directory, expected an audio file: name a file in it")
        if self.path.is_fifo():
            raise self._error("is a pipe, expected a file, which is read twice: write it to a file first")
        try:
            with open(self.path, "rb") as file:
                start = file.read(16)
        except FileNotFoundError:
            raise self._error(f"does not exist: check the path (looked from {Path.cwd()})") from None
        except OSError as error:
            raise self._error(f"cannot be read: {error.strerror}") from None
        if not start:
            raise self._error("is empty (0 bytes), expected a WAV, FLAC or Ogg file: record or copy it again")

    def _open(self) -> soundfile.SoundFile:
        try:
            # as bytes: soundfile itself cannot encode a name that is no text
            return soundfile.SoundFile(self.path if sys.platform == "win32" else os.fsencode(self.path))
        except TypeError:  # a name that ends in .raw: soundfile would have to be told rate and format
            raise self._error(
                "has no header that says its rate; give raw s16le stereo (microphone, reference) on '-' instead"
            ) from None
        except soundfile.LibsndfileError as error:
            with open(self.path, "rb") as file:
                start = file.read(12)
            form = next((name for mark, name in OTHER_FORMS.items() if mark in (start[: len(mark)], start[4:8])), None)
            if form:
                made = f"ffmpeg -i {shlex.quote(str(self.path))} {shlex.quote(f'{self.path.stem}.wav')}"
                raise self._error(f"is {form}, expected WAV, FLAC or Ogg: convert it, for instance by {made}") from None
            found = f"starts with {start!r}" if start.isascii() else f"starts with the bytes {start.hex(' ')}"
            raise self._error(
                f"is not audio ({found}; {_reason(error)}), expected WAV, FLAC or Ogg: convert it"
            ) from None

    def _check_header(self, file: soundfile.SoundFile) -> None:
        if self.rate not in RATES:
            raise self._error(
                f"says its rate is {self.rate} Hz, expected {RATES.start} to {RATES.stop - 1} Hz: its header is damaged"
            )
        promised = re.search(r"^data\s*: (\d+) \(should be (\d+)\)", file.extra_info, re.MULTILINE)
        if promised and int(promised[1]) >= _ENDLESS:
            self.notes.append(
                f"{self.role} {self.path}: its header gives no length (written to a pipe?); read to the end of the file"
            )
        elif promised:
            held = f"it holds {promised[2]} of the {promised[1]} bytes of sound that its header promises"
            raise self._error(f"is truncated: {held}; copy it again, or re-save what is there")
        elif "without an End-Of-Stream flag" in file.extra_info:
            held = "the Ogg stream stops before its end mark"
            raise self._error(f"is truncated: {held}; copy it again, or re-save what is there")

    def _blocks(self, file: soundfile.SoundFile) -> Iterator[Array]:
        """Yield (n, channels) float32, some SAMPLE_RATE values each; where a decoder gives up, the error says at which second."""
        size = max(1, SAMPLE_RATE // self.channels)
        done = 0
        try:
            while len(data := file.read(size, dtype="float32", always_2d=True)):
                done += len(data)
                yield data
        except soundfile.LibsndfileError as error:
            where = f"after {done / self.rate:.2f} s of {file.frames / self.rate:.2f} s"
            raise self._error(f"is truncated or damaged {where} ({_reason(error)}): copy it again") from None

    def _scan(self, file: soundfile.SoundFile) -> int:
        """Read the whole file for what makes it unusable; return its samples per channel."""
        length = 0
        for data in self._blocks(file):
            if not np.isfinite(data).all():
                at, channel = (int(i) for i in np.argwhere(~np.isfinite(data))[0])
                where = f"sample {length + at} ({(length + at) / self.rate:.3f} s)"
                where += f" of channel {channel + 1}" if self.channels > 1 else ""
                raise self._error(f"holds {data[at, channel]} at {where}, expected finite samples: repair or cut it")
            if np.abs(data).max() > LOUDEST:
                loudest = data.flat[np.abs(data).argmax()]
                raise self._error(f"holds {loudest:g}, expected samples of a full scale of 1: its scaling is wrong")
            self.silent = self.silent and not delivered(data, self.wanted).any()
            length += len(data)
        if length == 0:
            raise self._error("is empty (a header and 0 samples), expected sound: record it again")
        if length < file.frames:
            raise self._error(
                f"is truncated: it holds {length} of the {file.frames} samples that its header promises; copy it again"
            )
        return length

    def _note_conversion(self) -> None:
        done = []
        if self.rate != SAMPLE_RATE:
            above = f" (it has nothing above {self.rate / 2000:g} kHz)" if self.rate < SAMPLE_RATE else ""
            done.append(f"{self.rate} Hz resampled to {SAMPLE_RATE} Hz{above}")
        if self.wanted is not None:
            named = "channels" if self.given > 1 else "channel"
            done.append(f"{named} {', '.join(map(str, self.wanted))} of {self.channels}")
        elif self.channels > 1:
            how = "microphones of an array: name them with --mic-channels"
            done.append(f"{self.channels} channels averaged to one ({how})")
        if done:
            self.notes.append(f"{self.role} {self.path}: {', '.join(done)}")


def _reason(error: soundfile.LibsndfileError) -> str:
    """The library's own words, without its prefix and full stop."""
    return error.error_string.strip().removeprefix("Error : ").rstrip(".")
