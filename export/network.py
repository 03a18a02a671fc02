"""The edge CRNN: a causal network that corrects the Wiener mask of 'ss' on the linear stage's error, one frame at a time.

Two encoders, one for what the microphone holds (error, microphone, and the error over what is expected of fan and
residual echo) and one for what the robot said (reference, echo estimate), meet in the middle, as the two branches of Li,
Hindriks & Kunneman (2024), section 3.2, do; a GRU remembers, a decoder with skips gives the correction. Before any
training the answer is that of 'ss'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, leaky_relu

from edgefilter.dsp.stft import StftConfig
from export import wiener

COMPRESSION = 0.3
"""Exponent of the magnitude features; the robot is 25 dB above the human, so levels have to be brought together."""
FLOOR = 1e-6
"""Least magnitude of a bin, so that the compression has a finite slope."""
LOGITS = 2.0
"""Logits of the mask's gain by which one unit of the decoder's first output corrects the prior."""
MOST_LOGITS = 8.0
"""Bound on that, 35 dB: beyond, a mask is as good as open or shut."""


@dataclass(frozen=True)
class EdgeConfig:
    """Sizes of an EdgeCrnn.

    channels: of the four encoder stages, each halving the frequencies; the first two exist per branch. hidden, layers: of
    the GRU. norm: "layer" over each frame, "batch", or "none". erb: bands that encoder and decoder work on, as wide as
    the ear's (a multiple of 16; 64 take two fifths of the operations), 0 for every frequency.
    """

    n_fft: int = 512
    hop: int = 256
    window: str = "root-hann"
    channels: tuple[int, int, int, int] = (16, 32, 48, 48)
    hidden: int = 256
    layers: int = 2
    norm: str = "layer"
    erb: int = 0

    @property
    def stft(self) -> StftConfig:
        """The transform on whose spectra the network works; the window is as long as the FFT."""
        return StftConfig(self.n_fft, self.hop, self.n_fft, self.window)

    @property
    def bands(self) -> int:
        """Frequencies without 0 Hz, a multiple of 16."""
        return self.n_fft // 2


class FrameNorm(nn.Module):
    """Layer norm of (frames, channels, 1, frequencies) over all but the first, in whichever memory order they come."""

    def __init__(self, channels: int, frequencies: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels, 1, frequencies))
        self.bias = nn.Parameter(torch.zeros(channels, 1, frequencies))

    def forward(self, x: Tensor) -> Tensor:
        if x.is_contiguous():
            return layer_norm(x, self.weight.shape, self.weight, self.bias)
        weight, bias = (p.permute(1, 2, 0).contiguous() for p in (self.weight, self.bias))
        return layer_norm(x.permute(0, 2, 3, 1), weight.shape, weight, bias).permute(0, 3, 1, 2)


class Stage(nn.Module):
    """Convolution along frequency, normalisation over the frame, leaky ReLU.

    Tensors are (frames, channels, 1, frequencies): channels innermost in training, where that is a quarter faster,
    frequencies innermost in the exported graph.
    """

    def __init__(
        self, inputs: int, outputs: int, frequencies: int, norm: str, stride: int = 1, kernel: int = 5
    ) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, (1, kernel), (1, stride), (0, kernel // 2), bias=norm != "batch")
        self.norm = {
            "layer": lambda: FrameNorm(outputs, frequencies // stride),
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
        if y.is_contiguous():
            pairs = y.reshape(n, 2, channels // 2, frequencies).permute(0, 2, 3, 1)
            return pairs.reshape(n, channels // 2, 1, 2 * frequencies)
        return y.permute(0, 2, 3, 1).reshape(n, 1, 2 * frequencies, channels // 2).permute(0, 3, 1, 2)


class EdgeCrnn(nn.Module):
    """Maps the spectra of error, mic, reference and echo, and the powers of noise and residual, to the human and the probability of speech.

    The human is two spectra. The first is to listen to, the second for a recogniser, to which a fan does less harm than gaps in a
    voice: a head of two convolutions corrects the first one's mask.

    The state is the previous frame's features of each of the two branches (batch, 6, bands), the power of what the prior mask left
    of the previous frame (batch, bins) and the GRU's (layers, batch, hidden).
    """

    def __init__(self, config: EdgeConfig = EdgeConfig()) -> None:
        super().__init__()
        self.config = config
        c1, c2, c3, c4 = config.channels
        f, norm = config.erb or config.bands, config.norm
        if config.erb:
            spread = erb_bands(config.stft, config.erb)
            self.register_buffer("pooling", (spread / spread.sum(1, keepdim=True)).T.contiguous(), persistent=False)
            self.register_buffer("spreading", spread, persistent=False)
        self.mic_1, self.mic_2 = Stage(15, c1, f, norm, 2), Stage(c1, c2, f // 2, norm, 2)
        self.ref_1, self.ref_2 = Stage(12, c1, f, norm, 2), Stage(c1, c2, f // 2, norm, 2)
        self.joint_1, self.joint_2 = Stage(2 * c2, c3, f // 4, norm, 2), Stage(c3, c4, f // 8, norm, 2)
        self.inward = nn.Linear(c4 * f // 16, config.hidden)
        self.memory = nn.GRU(config.hidden, config.hidden, config.layers, batch_first=True)
        self.outward = nn.Linear(config.hidden, c4 * f // 16)
        self.up_4, self.up_3 = Upward(2 * c4, c3, f // 16, norm), Upward(2 * c3, c2, f // 8, norm)
        self.up_2, self.up_1 = Upward(3 * c2, c1, f // 4, norm), Upward(3 * c1, c1, f // 2, norm)
        self.mask = nn.Conv2d(c1, 2, (1, 3), padding=(0, 1))
        self.recognise = nn.Sequential(
            nn.Conv2d(c1, c1, (1, 3), padding=(0, 1)), nn.LeakyReLU(0.1), nn.Conv2d(c1, 2, (1, 3), padding=(0, 1))
        )
        self.speech = nn.Linear(config.hidden, 1)
        for last in (self.mask, self.recognise[-1]):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def initial_state(self, batch: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """All zeros: before the first frame there was silence."""
        zeros = self.inward.weight.new_zeros
        return (
            zeros(batch, 6, self.config.bands),
            zeros(batch, 6, self.config.bands),
            zeros(batch, self.config.bands + 1),
            zeros(self.config.layers, batch, self.config.hidden),
        )

    def forward(
        self,
        error: Tensor,
        mic: Tensor,
        reference: Tensor,
        echo: Tensor,
        noise: Tensor,
        residual: Tensor,
        state: tuple[Tensor, ...],
    ) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, ...]]:
        """Both spectra, logits (batch, frames) and the next state from spectra (batch, frames, bins, 2) and powers (batch, frames, bins)."""
        batch, frames = error.shape[:2]
        mic_x, mic_last = _with_previous(torch.cat((features(error), features(mic)), -1), state[0])
        ref_x, ref_last = _with_previous(torch.cat((features(reference), features(echo)), -1), state[1])
        with torch.no_grad():
            observed = error.square().sum(-1)
            ratio, answered = wiener.ratios(observed, noise + residual, state[2])
            expected = wiener.features(observed, noise, residual, ratio)[..., 1:, :]
        mic_x = torch.cat((mic_x, expected), -1)
        met, skips = self.encode(_channels_last(mic_x), _channels_last(ref_x))
        remembered, hidden = self.memory(torch.relu(self.inward(met.reshape(batch, frames, -1))), state[3])
        raw = self.decode(remembered, met, skips).permute(0, 2, 3, 1).reshape(batch, frames, self.config.bands, 4)
        listen, recognise = nn.functional.pad(raw.float(), (0, 0, 1, 0)).split(2, -1)
        gain = wiener.gain(ratio)
        sounds = corrected(gain, listen, error), corrected(gain, recognise, error)
        return *sounds, self.speech(remembered).squeeze(-1), (mic_last, ref_last, answered, hidden)

    def encode(self, mic: Tensor, reference: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Features of either branch, (n, 15 and 12, 1, bands), to where both meet, and the skips to the decoder."""
        if self.config.erb:
            mic, reference = (_on_bands(x, self.pooling) for x in (mic, reference))
        m1, r1 = self.mic_1(mic), self.ref_1(reference)
        m2, r2 = self.mic_2(m1), self.ref_2(r1)
        j1 = self.joint_1(torch.cat((m2, r2), 1))
        return self.joint_2(j1), (m1, r1, m2, r2, j1)

    def decode(self, remembered: Tensor, met: Tensor, skips: tuple[Tensor, ...]) -> Tensor:
        """The raw corrections (n, 4, 1, bands), two for each sound, from the GRU's output (remembered) and both outputs of `encode`."""
        m1, r1, m2, r2, j1 = skips
        y = torch.relu(self.outward(remembered)).reshape(met.shape)
        if not met.is_contiguous():
            y = y.contiguous(memory_format=torch.channels_last)
        y = self.up_3(torch.cat((self.up_4(torch.cat((y, met), 1)), j1), 1))
        y = self.up_1(torch.cat((self.up_2(torch.cat((y, m2, r2), 1)), m1, r1), 1))
        listen = self.mask(y)
        raw = torch.cat((listen, listen + self.recognise(y)), 1)
        return _on_bands(raw, self.spreading) if self.config.erb else raw

    def step(
        self,
        error: Tensor,
        mic: Tensor,
        reference: Tensor,
        echo: Tensor,
        noise: Tensor,
        residual: Tensor,
        state: tuple[Tensor, ...],
    ) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, ...]]:
        """One frame, spectra (1, bins, 2) and powers (1, bins): both spectra, the probability (1,) of speech, the next state."""
        frame = (x.unsqueeze(1) for x in (error, mic, reference, echo, noise, residual))
        listen, recognise, logit, state = self(*frame, state)
        return listen.squeeze(1), recognise.squeeze(1), torch.sigmoid(logit.squeeze(1)), state


def erb_rate(frequency_hz: np.ndarray) -> np.ndarray:
    """Place along the ear's frequency scale, in equivalent rectangular bandwidths (Glasberg & Moore 1990, eq. (4))."""
    return 21.4 * np.log10(1 + 0.00437 * frequency_hz)


def erb_bands(stft: StftConfig, count: int) -> Tensor:
    """Weights that spread bands over the frequencies above 0 Hz, linearly between their centres, (count, bins - 1).

    Centres are evenly spaced on the ERB-rate scale, but at least a bin apart.
    """
    frequencies = stft.frequencies[1:]
    rate = erb_rate(np.linspace(frequencies[0], frequencies[-1], 4096))
    wanted = np.interp(np.linspace(rate[0], rate[-1], count), rate, np.linspace(0, frequencies.size - 1, 4096))
    centres = np.rint(wanted).astype(int)
    for band in range(1, count):
        centres[band] = max(centres[band], centres[band - 1] + 1)
    bins = np.arange(frequencies.size)
    spread = np.stack([np.interp(bins, centres, np.eye(count)[band]) for band in range(count)])
    return torch.from_numpy(spread.astype(np.float32))


def _on_bands(x: Tensor, weights: Tensor) -> Tensor:
    """Return x (n, channels, 1, frequencies) times weights (frequencies, others), in the memory order in which x is.

    As one product: with the weights on the left, a copy of them is made for each of the n.
    """
    y = x.contiguous() @ weights
    return y if x.is_contiguous() else y.contiguous(memory_format=torch.channels_last)


def _with_previous(x: Tensor, previous: Tensor) -> tuple[Tensor, Tensor]:
    """The features x (batch, frames, bands, 6) beside those one frame earlier, (..., 12), and the last ones (batch, 6, bands)."""
    earlier = torch.cat((previous.transpose(1, 2).unsqueeze(1), x[:, :-1]), 1)
    return torch.cat((x, earlier), -1), x[:, -1].transpose(1, 2)


def _channels_last(x: Tensor) -> Tensor:
    """Reshape (batch, frames, bands, features) to (batch * frames, features, 1, bands), the features innermost in memory."""
    return x.reshape(-1, 1, *x.shape[2:]).permute(0, 3, 1, 2)


def features(spectrum: Tensor) -> Tensor:
    """Turn spectra (batch, frames, bins, 2) into real, imaginary part and magnitude, all compressed, (batch, frames, bins - 1, 3).

    0 Hz is left out.
    """
    return compressed(spectrum[:, :, 1:], -1)


def compressed(parts: Tensor, along: int) -> Tensor:
    """Real and imaginary parts, along that dimension, to these and the magnitude, all times the magnitude to COMPRESSION - 1.

    A power is the exponential of a logarithm: onnxruntime vectorises both, and its power not.
    """
    power = (parts * parts).sum(along, keepdim=True) + FLOOR**2
    return torch.cat((parts, power.sqrt()), along) * torch.exp((COMPRESSION - 1) / 2 * torch.log(power))


def corrected(prior: Tensor, raw: Tensor, error: Tensor) -> Tensor:
    """The error (..., 2) times the prior's gain (...), of which raw (..., 2) corrects logit and phase; zeros change nothing."""
    gain, turn = opened(prior, raw[..., 0]), raw[..., 1]
    real = gain * torch.rsqrt(1 + turn * turn)
    imaginary = turn * real
    x, y = error.unbind(-1)
    return torch.stack((real * x - imaginary * y, imaginary * x + real * y), -1)


def opened(prior: Tensor, raw: Tensor) -> Tensor:
    """sigmoid(logit(prior) + LOGITS raw), the correction bounded to MOST_LOGITS."""
    odds = torch.exp(MOST_LOGITS * torch.tanh(LOGITS / MOST_LOGITS * raw)) * prior
    return odds / (1 - prior + odds)


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
    power = spectrum[..., 0]
    with torch.no_grad():
        network(*4 * (spectrum,), power, power, network.initial_state())
    for hook in hooks:
        hook.remove()
    return {"parameters": sum(p.numel() for p in network.parameters()), "macs_per_frame": total}
