"""The edge CRNN: a causal network that masks the linear stage's error, one frame at a time.

Two encoders, one for what the microphone holds (error, microphone) and one for what the robot said (reference, echo
estimate), meet in the middle, as the two branches of Li, Hindriks & Kunneman (2024), section 3.2, do; a GRU remembers,
a decoder with skips gives a complex mask.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from edgefilter.dsp.stft import StftConfig

COMPRESSION = 0.3
"""Exponent of the magnitude features; the robot is 25 dB above the human, so levels have to be brought together."""
FLOOR = 1e-6
"""Least magnitude of a bin, so that the compression has a finite slope."""


@dataclass(frozen=True)
class EdgeConfig:
    """channels: of the four encoder stages, each halving the frequencies; the first two exist per branch.

    Hidden, layers: of the GRU.

    norm: "layer" over each frame, "batch", or "none".
    """

    n_fft: int = 512
    hop: int = 256
    window: str = "root-hann"
    channels: tuple[int, int, int, int] = (16, 32, 48, 48)
    hidden: int = 256
    layers: int = 2
    norm: str = "layer"

    @property
    def stft(self) -> StftConfig:
        """The transform on whose spectra the network works; the window is as long as the FFT."""
        return StftConfig(self.n_fft, self.hop, self.n_fft, self.window)

    @property
    def bands(self) -> int:
        """Frequencies without 0 Hz, a multiple of 16."""
        return self.n_fft // 2


class Stage(nn.Module):
    """Convolution along frequency, normalisation over the frame, leaky ReLU.

    Tensors are (frames, channels, 1, frequencies).
    """

    def __init__(
        self, inputs: int, outputs: int, frequencies: int, norm: str, stride: int = 1, kernel: int = 5
    ) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, (1, kernel), (1, stride), (0, kernel // 2), bias=norm != "batch")
        shape = [outputs, 1, frequencies // stride]
        self.norm = {
            "layer": lambda: nn.LayerNorm(shape),
            "batch": lambda: nn.BatchNorm2d(outputs),
            "none": nn.Identity,
        }[norm]()

    def forward(self, x: Tensor) -> Tensor:
        return leaky_relu(self.norm(self.convolution(x)), 0.1)


class Upward(nn.Module):
    """A stage that doubles the frequencies: twice the channels, then every other one beside its neighbour."""

    def __init__(self, inputs: int, outputs: int, frequencies: int, norm: str) -> None:
        super().__init__()
        self.stage = Stage(inputs, 2 * outputs, frequencies, norm, kernel=3)

    def forward(self, x: Tensor) -> Tensor:
        y = self.stage(x)
        n, channels, _, frequencies = y.shape
        return (
            y.reshape(n, 2, channels // 2, frequencies)
            .permute(0, 2, 3, 1)
            .reshape(n, channels // 2, 1, 2 * frequencies)
        )


class EdgeCrnn(nn.Module):
    """(error, mic, reference, echo) spectra to the human's spectrum and the probability that somebody speaks.

    State: the previous frame's features of either branch (batch, 6, bands) and the GRU's (layers, batch, hidden).
    """

    def __init__(self, config: EdgeConfig = EdgeConfig()) -> None:
        super().__init__()
        self.config = config
        c1, c2, c3, c4 = config.channels
        f, norm = config.bands, config.norm
        self.mic_1, self.mic_2 = Stage(12, c1, f, norm, 2), Stage(c1, c2, f // 2, norm, 2)
        self.ref_1, self.ref_2 = Stage(12, c1, f, norm, 2), Stage(c1, c2, f // 2, norm, 2)
        self.joint_1, self.joint_2 = Stage(2 * c2, c3, f // 4, norm, 2), Stage(c3, c4, f // 8, norm, 2)
        self.inward = nn.Linear(c4 * f // 16, config.hidden)
        self.memory = nn.GRU(config.hidden, config.hidden, config.layers, batch_first=True)
        self.outward = nn.Linear(config.hidden, c4 * f // 16)
        self.up_4, self.up_3 = Upward(2 * c4, c3, f // 16, norm), Upward(2 * c3, c2, f // 8, norm)
        self.up_2, self.up_1 = Upward(3 * c2, c1, f // 4, norm), Upward(3 * c1, c1, f // 2, norm)
        self.mask = nn.Conv2d(c1, 2, (1, 3), padding=(0, 1))
        self.speech = nn.Linear(config.hidden, 1)
        with torch.no_grad():
            self.mask.bias.copy_(torch.tensor([0.5, 0.0]))

    def initial_state(self, batch: int = 1) -> tuple[Tensor, Tensor, Tensor]:
        """All zeros: before the first frame there was silence."""
        zeros = self.inward.weight.new_zeros
        return (
            zeros(batch, 6, self.config.bands),
            zeros(batch, 6, self.config.bands),
            zeros(self.config.layers, batch, self.config.hidden),
        )

    def forward(
        self, error: Tensor, mic: Tensor, reference: Tensor, echo: Tensor, state: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Spectra (batch, frames, bins, 2) to the human's (batch, frames, bins, 2), logits (batch, frames), and the next state."""
        batch, frames = error.shape[:2]
        mic_x, mic_last = self._with_previous(torch.cat((features(error), features(mic)), 2), state[0])
        ref_x, ref_last = self._with_previous(torch.cat((features(reference), features(echo)), 2), state[1])
        met, skips = self.encode(mic_x, ref_x)
        remembered, hidden = self.memory(torch.relu(self.inward(met.reshape(batch, frames, -1))), state[2])
        raw = self.decode(remembered, met, skips).reshape(batch, frames, 2, self.config.bands)
        return apply_mask(raw.float(), error), self.speech(remembered).squeeze(-1), (mic_last, ref_last, hidden)

    def encode(self, mic: Tensor, reference: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Features of either branch beside those of the frame before, (n, 12, 1, bands), to where both meet, and the skips to the decoder."""
        m1, r1 = self.mic_1(mic), self.ref_1(reference)
        m2, r2 = self.mic_2(m1), self.ref_2(r1)
        j1 = self.joint_1(torch.cat((m2, r2), 1))
        return self.joint_2(j1), (m1, r1, m2, r2, j1)

    def decode(self, remembered: Tensor, met: Tensor, skips: tuple[Tensor, ...]) -> Tensor:
        """The GRU's output with what `encode` gave to the raw mask (n, 2, 1, bands)."""
        m1, r1, m2, r2, j1 = skips
        y = torch.relu(self.outward(remembered)).reshape(met.shape)
        y = self.up_3(torch.cat((self.up_4(torch.cat((y, met), 1)), j1), 1))
        y = self.up_1(torch.cat((self.up_2(torch.cat((y, m2, r2), 1)), m1, r1), 1))
        return self.mask(y)

    def step(
        self, error: Tensor, mic: Tensor, reference: Tensor, echo: Tensor, state: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """One frame: spectra (1, bins, 2) to the human's (1, bins, 2), the probability (1,) that somebody speaks, and the next state."""
        frame = (spectrum.unsqueeze(1) for spectrum in (error, mic, reference, echo))
        human, logit, state = self(*frame, state)
        return human.squeeze(1), torch.sigmoid(logit.squeeze(1)), state

    def _with_previous(self, x: Tensor, previous: Tensor) -> tuple[Tensor, Tensor]:
        """Features (batch, frames, 6, bands) beside those one frame earlier, (batch * frames, 12, 1, bands), and the last ones."""
        earlier = torch.cat((previous.unsqueeze(1), x[:, :-1]), 1)
        both = torch.cat((x, earlier), 2)
        return both.reshape(-1, 12, 1, self.config.bands), x[:, -1]


def features(spectrum: Tensor) -> Tensor:
    """(batch, frames, bins, 2) to real, imaginary part and magnitude, all compressed, (batch, frames, 3, bins - 1).

    0 Hz is left out.
    """
    return compressed(spectrum[:, :, 1:].transpose(-1, -2))


def compressed(parts: Tensor) -> Tensor:
    """Real and imaginary parts (..., 2, bands) to these and the magnitude, (..., 3, bands), all times the magnitude to COMPRESSION - 1.

    A power is the exponential of a logarithm: onnxruntime vectorises both, and its power not.
    """
    power = (parts * parts).sum(-2, keepdim=True) + FLOOR**2
    return torch.cat((parts, power.sqrt()), -2) * torch.exp((COMPRESSION - 1) / 2 * torch.log(power))


def apply_mask(raw: Tensor, error: Tensor) -> Tensor:
    """Error (..., bins, 2) times a complex mask of magnitude tanh |raw|.

    Raw is (..., 2, bins - 1), 0 Hz is silenced.
    """
    return nn.functional.pad(masked(raw, error[..., 1:, :].transpose(-1, -2)), (1, 0)).transpose(-1, -2).contiguous()


def masked(raw: Tensor, error: Tensor) -> Tensor:
    """The same with real and imaginary parts as rows: raw, error and the result (..., 2, bins - 1)."""
    size = torch.sqrt((raw * raw).sum(-2, keepdim=True) + 1e-8)
    real, imaginary = (raw * (torch.tanh(size) / size)).split(1, -2)
    x, y = error.split(1, -2)
    return torch.cat((real * x - imaginary * y, real * y + imaginary * x), -2)


def count(network: EdgeCrnn) -> dict[str, float]:
    """Parameters, and multiply-accumulates per frame of convolutions, linear layers and GRU."""
    total = 0

    def add(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        nonlocal total
        if isinstance(module, nn.Conv2d):
            total += output[0].numel() * module.in_channels * module.kernel_size[1]
        elif isinstance(module, nn.Linear):
            total += module.weight.numel()
        elif isinstance(module, nn.GRU):
            total += sum(weight.numel() for name, weight in module.named_parameters() if name.startswith("weight"))

    hooks = [module.register_forward_hook(add) for module in network.modules()]
    spectrum = torch.zeros(1, 1, network.config.n_fft // 2 + 1, 2)
    with torch.no_grad():
        network(spectrum, spectrum, spectrum, spectrum, network.initial_state())
    for hook in hooks:
        hook.remove()
    return {"parameters": sum(p.numel() for p in network.parameters()), "macs_per_frame": total}
