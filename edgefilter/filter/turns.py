"""The finished turn of the human: filtered once more when it is over, with what is known at its end."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.dsp.stft import StftConfig
from edgefilter.filter.spatial import SpatialFilter
from edgefilter.types import SAMPLE_RATE, Event, Samples, Spectrum, Turn

LONGEST_S = 30.0
"""Of a turn that is kept; what a recogniser takes at once. Of a longer one the latest part."""
BEFORE_S = 0.5
"""Of sound before the human was noticed: they had begun to speak, and a recogniser wants some silence first."""
RECENT_S = 0.3
"""Seconds of output before a beginning or an end of speech that its event carries: the syllable before the human was noticed."""
WAITING_S = 600.0
"""Of the turns in events that nobody has asked for yet, 38 MB in all; a thousand events could hold a gigabyte."""


class Turns:
    """Keeps the latest frames of one stream; step once a frame.

    spatial: of an array; with one microphone a second look finds nothing new, and the turn is what was streamed. Of an
    array's frame the errors and the engine's answer over the error are kept, (microphones + 1, bins), so that another spatial
    filter costs no second run of the engine; else the answer, (1, bins).
    """

    def __init__(self, stft: StftConfig, spatial: SpatialFilter | None) -> None:
        self._stft, self._spatial = stft, spatial
        self._before = round(BEFORE_S * SAMPLE_RATE / stft.hop)
        self._frames: deque[Spectrum] = deque(maxlen=round(LONGEST_S * SAMPLE_RATE / stft.hop))
        self._count = self._begin = 0

    def step(self, answer: Spectrum, error: Spectrum, errors: Spectrum | None) -> None:
        """Keep a frame: the engine's output and the error it was given, (bins,); errors of all microphones, (microphones, bins), of an array."""
        frame: list[np.ndarray] = [answer]
        if errors is not None:
            gain = np.divide(answer, error, out=np.zeros_like(answer), where=error != 0.0)
            # an engine's output is no louder than its input, but where that is all but zero their ratio may say so
            frame = [*errors, gain / np.maximum(np.abs(gain), 1.0)]
        self._frames.append(np.array(frame, np.complex64))
        self._count += 1

    def start(self, waited: int = 0) -> None:
        """A turn has begun so many frames before the latest."""
        self._begin = self._count - 1 - waited - self._before

    def finish(self) -> Turn:
        """The turn up to the latest frame, a whole number of hops."""
        return self._since(self._begin)

    def recent(self, waited: int = 0) -> Turn:
        """From RECENT_S, or a hop more, before the frame that came so many frames before the latest, to that."""
        frames = -(-round(RECENT_S * SAMPLE_RATE) // self._stft.hop) + 1 + waited  # the latest ends with half a window
        return self._since(self._count - frames)

    def _since(self, first: int) -> Turn:
        """The frames from the first, or the first that is kept, to the latest."""
        first = max(first, self._count - len(self._frames))
        kept = np.stack(list(self._frames)[first - self._count :])
        spectra = kept[:, 0]
        if self._spatial is not None:
            weights = self._spatial.finished()
            spectra = sum(weight.conj() * kept[:, at] for at, weight in enumerate(weights)) * kept[:, -1]
        late = self._stft.window_length - self._stft.hop
        # frame t ends with sample (t + 1) hop; the first `late` samples lack the frame before, the last `late` the one after
        return Turn(first * self._stft.hop, overlap_add(spectra, self._stft)[late : -late or None])


def drop_sound(events: deque[Event]) -> None:
    """Keep the sound of the latest turns alone, WAITING_S in all, in events that wait to be asked for, the oldest first."""
    left = round(WAITING_S * SAMPLE_RATE)
    for at in reversed(range(len(events))):
        if (turn := events[at].turn) is not None:
            left -= turn.samples.size
            if left < 0:
                events[at] = replace(events[at], turn=None)


def overlap_add(spectra: Spectrum, stft: StftConfig) -> Samples:
    """Samples of the frames spectra (frames, bins), ((frames - 1) hop + window_length,) float32."""
    pieces = -(-stft.window_length // stft.hop)
    frames = fourier.irfft(np.ascontiguousarray(spectra, np.complex64), stft.n_fft)[:, : stft.window_length]
    windowed = np.zeros((len(frames), pieces * stft.hop), np.float32)
    windowed[:, : stft.window_length] = frames * stft.synthesis_window
    out = np.zeros((len(frames) + pieces - 1, stft.hop), np.float32)
    for piece in range(pieces):
        out[piece : piece + len(frames)] += windowed[:, piece * stft.hop : (piece + 1) * stft.hop]
    return out.ravel()[: (len(frames) - 1) * stft.hop + stft.window_length]
