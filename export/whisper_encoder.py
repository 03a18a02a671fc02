"""The first layers of Whisper's encoder as a frozen torch module: what a recogniser makes of a sound, for a loss.

    python -m export.whisper_encoder WHISPER        compare all layers with CTranslate2's own on random sound

WHISPER: a folder in CTranslate2's format, of which model.bin is read.
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import conv1d, gelu, layer_norm, linear, scaled_dot_product_attention

from bench.mel import mel_filters
from edgefilter.errors import EdgefilterError, ModelError

N_FFT, HOP = 400, 160
"""Of Whisper's spectra, 25 and 10 ms (Radford et al. 2022, section 2.2)."""
DYNAMIC = 8.0
"""Decades below the loudest that a log-mel spectrum keeps."""
FORMAT = 6
"""Version of CTranslate2's files that is read."""
TYPES = {0: np.float32, 1: np.int8, 2: np.int16, 3: np.int32, 4: np.float16}


def read_weights(path: Path, prefix: str = "encoder/") -> dict[str, np.ndarray]:
    """The arrays of CTranslate2's model.bin whose names begin with the prefix, without it; raises ModelError for another file."""
    found = {}
    try:
        with path.open("rb") as file:
            version = _number(file, "I")
            if version != FORMAT:
                raise ModelError(f"{path} is of format {version}, expected {FORMAT}: convert it with CTranslate2 4")
            _text(file), _number(file, "I")  # kind of model and its revision
            for _ in range(_number(file, "I")):
                name, rank = _text(file), _number(file, "B")
                shape = [_number(file, "I") for _ in range(rank)]
                kind, size = _number(file, "B"), _number(file, "I")
                if name.startswith(prefix):
                    found[name.removeprefix(prefix)] = np.frombuffer(file.read(size), TYPES[kind]).reshape(shape)
                else:
                    file.seek(size, 1)
    except (struct.error, KeyError, ValueError, UnicodeDecodeError) as error:
        raise ModelError(f"{path} is not CTranslate2's model.bin, or is cut short: {error}") from error
    return found


def _number(file: BinaryIO, kind: str) -> int:
    return struct.unpack(f"<{kind}", file.read(struct.calcsize(kind)))[0]


def _text(file: BinaryIO) -> str:
    return file.read(_number(file, "H"))[:-1].decode()


class WhisperEncoder(nn.Module):
    """Whisper's encoder up to some layer; its weights do not learn.

    layers: how many of the transformer's, None for all and the norm behind them.
    """

    def __init__(self, folder: Path, layers: int | None = 2) -> None:
        super().__init__()
        weights = read_weights(folder / "model.bin")
        self.heads = int(weights["num_heads"])
        self.blocks = sum(name.endswith("linear_0/weight") for name in weights) // 2
        self.layers = self.blocks if layers is None else min(layers, self.blocks)
        self.whole = layers is None
        for name, array in weights.items():
            if array.dtype in (np.float16, np.float32):
                self.register_buffer(name.replace("/", "_"), torch.from_numpy(array.astype(np.float32)))
        self.register_buffer("mel", torch.from_numpy(mel_filters(self.conv1_weight.shape[1], N_FFT)))
        self.register_buffer("window", torch.hann_window(N_FFT))

    def log_mel(self, samples: Tensor) -> Tensor:
        """Turn samples (batch, n) at 16 kHz into log mel spectra (batch, mels, n / HOP), as Whisper is fed."""
        spectrum = torch.stft(samples, N_FFT, HOP, window=self.window, center=True, return_complex=True)[..., :-1]
        power = torch.view_as_real(spectrum).square().sum(-1)
        level = (self.mel @ power).clamp(min=1e-10).log10()
        return (torch.maximum(level, level.amax((1, 2), keepdim=True) - DYNAMIC) + 4.0) / 4.0

    def forward(self, log_mel: Tensor) -> list[Tensor]:
        """Turn (batch, mels, frames) into what each layer answers, (batch, frames / 2, width), that of the convolutions first."""
        x = gelu(conv1d(log_mel, self.conv1_weight, self.conv1_bias, padding=1))
        x = gelu(conv1d(x, self.conv2_weight, self.conv2_bias, stride=2, padding=1)).transpose(1, 2)
        x = x + self.position_encodings_encodings[: x.shape[1]]
        answers = [x]
        for number in range(self.layers):
            answers.append(self._layer(f"layer_{number}_", answers[-1]))
        if self.whole:
            answers.append(self._normalised("", answers[-1]))
        return answers

    def _layer(self, name: str, x: Tensor) -> Tensor:
        attention, feed = f"{name}self_attention_", f"{name}ffn_"
        batch, frames, width = x.shape
        parts = self._linear(f"{attention}linear_0", self._normalised(attention, x))
        parts = parts.reshape(batch, frames, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        heard = scaled_dot_product_attention(*parts).transpose(1, 2).reshape(batch, frames, width)
        x = x + self._linear(f"{attention}linear_1", heard)
        inner = gelu(self._linear(f"{feed}linear_0", self._normalised(feed, x)))
        return x + self._linear(f"{feed}linear_1", inner)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return linear(x, getattr(self, f"{name}_weight"), getattr(self, f"{name}_bias"))

    def _normalised(self, name: str, x: Tensor) -> Tensor:
        gamma, beta = (getattr(self, f"{name}layer_norm_{part}") for part in ("gamma", "beta"))
        return layer_norm(x, gamma.shape, gamma, beta)


@torch.no_grad()
def parity(folder: Path, seed: int = 0) -> float:
    """Largest difference of all layers from CTranslate2's own, over their spread, on a random spectrum of 30 s."""
    import ctranslate2

    encoder = WhisperEncoder(folder, layers=None)
    frames = 2 * encoder.position_encodings_encodings.shape[0]
    fed = np.random.default_rng(seed).uniform(-1, 1, (1, encoder.mel.shape[0], frames)).astype(np.float32)
    theirs = ctranslate2.models.Whisper(str(folder), compute_type="float32").encode(
        ctranslate2.StorageView.from_array(fed)
    )
    ours = encoder(torch.from_numpy(fed))[-1]
    return float(np.abs(ours.numpy() - np.array(theirs)).max() / np.array(theirs).std())


if __name__ == "__main__":
    try:
        print(f"largest difference over the spread: {parity(Path(sys.argv[1])):.1e}")
    except IndexError:
        sys.exit(str(__doc__))
    except (EdgefilterError, OSError) as error:
        sys.exit(f"whisper_encoder: {error}")
