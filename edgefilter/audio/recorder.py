"""Keeps the sound of a run: what came in, and what went out."""

from __future__ import annotations

from pathlib import Path

from edgefilter.audio.files import FileSink, make_folder
from edgefilter.errors import AudioFileError
from edgefilter.types import SAMPLE_RATE, Block, Samples

NAMES = ("mic.wav", "reference.wav", "output.wav")
MOST = (2**32 - 2**16) // 4
"""Samples of 32 bit that the size field of a WAV file can count: 18.6 hours."""


class Recorder:
    """FOLDER/mic.wav, reference.wav and output.wav, 32-bit float: exactly the samples of the blocks, and the filter's.

    microphones: channels of mic.wav.

    A disk that is full ends the recording and not the run: what was written stays valid, and the error stands in
    `failure`. Raises AudioFileError where the folder or a file cannot be made.
    """

    def __init__(self, folder: str | Path, microphones: int) -> None:
        self.folder = Path(folder)
        self.failure: AudioFileError | None = None
        make_folder(self.folder, "the recording")
        self._files: list[FileSink] = []
        try:
            for name, channels in zip(NAMES, (microphones, 1, 1)):
                self._files.append(FileSink(self.folder / name, float32=True, channels=channels))
        except AudioFileError:
            self._close()
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
            if file.written * samples[:1].size + samples.size > MOST:
                hours = MOST / SAMPLE_RATE / 3600
                raise AudioFileError(
                    f"{file.path} holds {hours:.1f} hours, all that a WAV file can: the recording ends here"
                )
            file.write(samples)
        except AudioFileError as error:
            self.failure = error
            self._close()

    def _close(self) -> None:
        for file in self._files:
            file.close(quiet=True)
