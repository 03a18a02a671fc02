"""The mask network of VoiceFilter: dilated convolutions over a magnitude spectrogram, then layers that are told whose voice to keep.

Wang et al. (2019), "VoiceFilter: Targeted Voice Separation by Speaker-Conditioned Spectrogram Masking", section 2.2
and table 1, narrower and on this project's transform.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from edgefilter.dsp.stft import StftConfig
from export.paper_network import convolutions

COMPRESSION = 0.3
"""Exponent of the magnitudes that the first convolution gets, and of those that the loss compares."""
QUIET = 1e-4
"""Added to magnitudes over their root mean square: near digital silence the exponent's slope has no end."""


@dataclass(frozen=True)
class VoiceFilterConfig:
    """Widths, small ones: Wang et al. have 64 channels, 8 of the last convolution, 400 recurrent and 600 dense units.

    n_fft, hop: of the transform, whose root-Hann window is as long as the FFT. d_vector: length of a speaker's embedding.
    """

    n_fft: int = 512
    hop: int = 256
    channels: int = 16
    last: int = 4
    hidden: int = 128
    dense: int = 256
    d_vector: int = 256

    @property
    def stft(self) -> StftConfig:
        return StftConfig(self.n_fft, self.hop, self.n_fft)


class VoiceFilter(nn.Module):
    """A soft mask for one voice from the magnitudes of a whole clip, so it answers only at the clip's end.

    As in Park's implementation, which later work compares with, batch normalisation follows each convolution and the
    recurrent layer reads in both directions. The clip is brought to one level first: a louder one has the same mask.
    """

    def __init__(self, config: VoiceFilterConfig = VoiceFilterConfig()) -> None:
        super().__init__()
        self.config = config
        bins = config.stft.bins
        self.convolutions = convolutions((*(config.channels,) * 7, config.last), batch_norm=True)
        self.blstm = nn.LSTM(config.last * bins + config.d_vector, config.hidden, batch_first=True, bidirectional=True)
        self.dense = nn.Sequential(
            nn.Linear(2 * config.hidden, config.dense), nn.ReLU(), nn.Linear(config.dense, bins), nn.Sigmoid()
        )

    def forward(self, magnitude: Tensor, d_vector: Tensor) -> Tensor:
        """Mask in 0 to 1, (batch, frames, bins), from magnitude (batch, frames, bins) and d_vector (batch, values)."""
        level = magnitude.square().mean((1, 2), keepdim=True).sqrt() + 1e-9
        compressed = (magnitude / level + QUIET) ** COMPRESSION
        features = self.convolutions(compressed.unsqueeze(1)).transpose(1, 2).flatten(2)
        told = d_vector.unsqueeze(1).expand(-1, features.shape[1], -1)
        recurrent, _ = self.blstm(torch.cat((features, told), 2))
        return self.dense(torch.relu(recurrent))
