"""Spectrograms as PNG and sound as Opus, both as data addresses that a page carries inside itself."""

from __future__ import annotations

import base64
import io
import struct
import zlib

import numpy as np
import soundfile

from edgefilter.dsp.fourier import power
from edgefilter.dsp.frames import decibels, frames
from edgefilter.dsp.psd import hann
from edgefilter.dsp.stft import StftConfig
from edgefilter.types import SAMPLE_RATE, Samples

MAX_COLUMNS = 800
"""Columns that a spectrogram has at most."""
LEVELS = 64
"""How many colours there are."""
MAX_SOUND_S = 60
"""How much of a recording a page carries as sound."""
_ANCHORS = "080814 26164a 59206e 932c67 c93e4e ee682d faa422 fcde78 fffce1"
"""Red, green and blue, dark to bright, each step about as much lighter as the one before."""


def spectrogram_db(samples: Samples) -> np.ndarray:
    """Level in dB of full scale per bin, Hann frames of 32 ms, mean power where frames share a column, (columns, 257)."""
    size, hop = StftConfig().window_length, StftConfig().hop
    padded = np.pad(samples, (0, max(0, size - samples.size)))
    window = hann(size).astype(np.float32)
    count = 1 + (padded.size - size) // hop
    columns = min(count, MAX_COLUMNS)
    edges = np.linspace(0, count, columns + 1).astype(int)
    level = np.empty((columns, size // 2 + 1))
    pieces = frames(padded, size, hop)
    for column, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        level[column] = np.mean(power(np.fft.rfft(pieces[first:last] * window, axis=1)), axis=0)
    return decibels(level / (window.sum() / 2) ** 2, 1e-20)


def colour_scale(samples: Samples) -> tuple[float, float]:
    """Levels, dB of full scale per bin, that get the darkest and the brightest colour: from the quiet of a recording (n,) to nearly its loudest."""
    quiet, loud = np.percentile(spectrogram_db(samples), (20, 99.7))
    top = 5.0 * float(np.ceil(max(loud, -140.0) / 5.0))
    return min(5.0 * float(np.floor(quiet / 5.0)), top - 40.0), top


def spectrogram_png(samples: Samples, scale: tuple[float, float]) -> str:
    """The spectrogram as a data address, low frequencies at the bottom, coloured on that scale."""
    bottom, top = scale
    index = np.clip(np.round((spectrogram_db(samples) - bottom) / (top - bottom) * (LEVELS - 1)), 0, LEVELS - 1)
    return _address("image/png", _png(index.astype(np.uint8).T[::-1], colours()))


def colours() -> np.ndarray:
    """Colours, darkest first, (LEVELS, 3) uint8."""
    anchors = np.frombuffer(bytes.fromhex(_ANCHORS), np.uint8).reshape(-1, 3)
    at = np.linspace(0, len(anchors) - 1, LEVELS)
    channels = [np.interp(at, np.arange(len(anchors)), channel) for channel in anchors.T]
    return np.stack(channels, axis=1).astype(np.uint8)


def sound(samples: Samples, gain: float) -> str:
    """The first MAX_SOUND_S of samples (n,) times gain, as an Opus data address, about 30 kbit/s."""
    buffer = io.BytesIO()
    loud = np.clip(samples[: MAX_SOUND_S * SAMPLE_RATE] * np.float32(gain), -1.0, 1.0)
    soundfile.write(buffer, loud, SAMPLE_RATE, format="OGG", subtype="OPUS")
    return _address("audio/ogg", buffer.getvalue())


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _png(index: np.ndarray, palette: np.ndarray) -> bytes:
    """A PNG (ISO/IEC 15948) of index (rows, columns) uint8 into palette (n, 3) uint8."""
    rows, columns = index.shape
    lines = np.concatenate((np.zeros((rows, 1), np.uint8), index), axis=1).tobytes()
    header = struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"PLTE", palette.tobytes()), (b"IDAT", zlib.compress(lines, 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
