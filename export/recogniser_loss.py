"""What a recogniser's first layers make of the answer, against what they make of the human alone."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import fold

from edgefilter.dsp.stft import StftConfig
from edgefilter.types import SAMPLE_RATE
from export.whisper_encoder import WhisperEncoder

LISTENED_S = 16.0
"""Seconds of a batch that are listened to: the first layers cost more than the network."""
ROOM_DB = -40.0
"""Level of the noise under both, over the human's: a recogniser never hears digital silence between words."""


class RecogniserLoss:
    """Mean squared distance of the layers' answers, each over the spread of the human's (Plantinga et al. 2020, "Phonetic feedback").

    folder: Whisper in CTranslate2's format. half: bfloat16 in the layers, which are frozen and forgive it.
    """

    def __init__(self, folder: Path, stft: StftConfig, layers: int = 2, half: bool = False) -> None:
        self.encoder = WhisperEncoder(folder, layers).eval()
        self.stft, self.half = stft, half
        self._window = torch.from_numpy(stft.synthesis_window.copy())
        self._noise = torch.Generator().manual_seed(0)

    def __call__(self, human: Tensor, clean: Tensor) -> Tensor:
        """The loss of spectra (batch, frames, bins, 2), over the first crops with a human, LISTENED_S together."""
        speaking = torch.nonzero(clean.square().sum((1, 2, 3)) > 1e-3)[:, 0]
        count = max(1, round(LISTENED_S * SAMPLE_RATE / (human.shape[1] * self.stft.hop)))
        if not speaking.numel():
            return human.new_zeros(())
        heard, wanted = (self.sound(spectra[speaking[:count]]) for spectra in (human, clean))
        level = wanted.square().mean(1, keepdim=True).sqrt()
        room = torch.randn(wanted.shape, generator=self._noise).to(wanted) * level * 10 ** (ROOM_DB / 20)
        with torch.no_grad():
            targets = self._layers(wanted + room)
        answers = self._layers(heard + room)
        apart = [
            (answer - target).square().mean() / target.var().clamp(min=1e-6) for answer, target in zip(answers, targets)
        ]
        return torch.stack(apart).mean()

    def _layers(self, sound: Tensor) -> list[Tensor]:
        """What each layer makes of sounds (batch, samples)."""
        mel = self.encoder.log_mel(sound)
        with torch.autocast(mel.device.type, torch.bfloat16, enabled=self.half):
            return [answer.float() for answer in self.encoder(mel)]

    def sound(self, spectra: Tensor) -> Tensor:
        """Overlap and add spectra (batch, frames, bins, 2) to samples (batch, (frames - 1) hop), without either end, which lacks a neighbour."""
        hop, size = self.stft.hop, self.stft.window_length
        frames = torch.fft.irfft(torch.view_as_complex(spectra.contiguous()), self.stft.n_fft)[..., :size]
        frames = (frames * self._window.to(frames)).transpose(1, 2)
        length = (frames.shape[2] - 1) * hop + size
        whole = fold(frames, (1, length), (1, size), stride=(1, hop))
        return whole[:, 0, 0, hop:-hop]
