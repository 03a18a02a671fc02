"""EdgeCrnn.step as a graph of few operators: the same answers and states, in the way that onnxruntime computes one frame fastest.

Encoder, decoder, features and mask are the network's own. Its own here are that the features of all four spectra are
computed at once, with the frequencies innermost, and that the layers of the GRU hand each other their states: a third
of the operators and a quarter of the time fall away.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from export import wiener
from export.network import EdgeCrnn, compressed, corrected


class EdgeGraph(nn.Module):
    """What onnx_export traces.

    products: the GRU as matrix products, which can be quantised, in place of ONNX's GRU operator, which cannot.
    """

    def __init__(self, network: EdgeCrnn, products: bool = False) -> None:
        super().__init__()
        self.network = network
        layer = ProductLayer if products else OperatorLayer
        self.memory = nn.ModuleList(layer(network.memory, number) for number in range(network.memory.num_layers))

    def forward(
        self,
        error: Tensor,
        mic: Tensor,
        reference: Tensor,
        echo: Tensor,
        noise: Tensor,
        residual: Tensor,
        mic_last: Tensor,
        ref_last: Tensor,
        answered: Tensor,
        hidden: Tensor,
    ) -> tuple[Tensor, ...]:
        """Spectra (1, bins, 2), powers (1, bins) and EdgeCrnn's state to what EdgeCrnn.step gives."""
        network = self.network
        spectra = torch.cat((error, mic, reference, echo))
        mic_now, ref_now = compressed(spectra[:, 1:].permute(0, 2, 1), -2).reshape(2, 6, -1).split(1)
        observed = (error * error).sum(-1)
        ratio, answered = wiener.step(observed, noise + residual + wiener.SILENCE, answered)
        expected = wiener.features(observed, noise, residual, ratio, 1)[:, :, 1:]
        met, skips = network.encode(_beside(mic_now, mic_last, expected), _beside(ref_now, ref_last))
        heard = torch.relu(network.inward(met.reshape(1, 1, -1)))
        following = []
        for layer, state in zip(self.memory, hidden.split(1)):
            heard = layer(heard, state)
            following.append(heard)
        raw = nn.functional.pad(network.decode(heard, met, skips).squeeze(2), (1, 0)).reshape(2, 2, -1).permute(0, 2, 1)
        listen, recognise = corrected(wiener.gain(ratio), raw, error).split(1)
        speech = torch.sigmoid(network.speech(heard)).reshape(1)
        return listen, recognise, speech, mic_now, ref_now, answered, torch.cat(following)


class OperatorLayer(nn.Module):
    """One layer of a GRU for one frame: input and state (1, 1, hidden) to the next state."""

    def __init__(self, memory: nn.GRU, number: int) -> None:
        super().__init__()
        self.layer = nn.GRU(memory.hidden_size, memory.hidden_size)
        self.layer.load_state_dict(
            {name: getattr(memory, name.replace("_l0", f"_l{number}")) for name in self.layer.state_dict()}
        )

    def forward(self, x: Tensor, state: Tensor) -> Tensor:
        return self.layer(x, state)[1]


class ProductLayer(nn.Module):
    """The same by two matrix products; gates in torch's order: reset, update, new."""

    def __init__(self, memory: nn.GRU, number: int) -> None:
        super().__init__()
        self.size = memory.hidden_size
        self.of_input, self.of_state = nn.Linear(self.size, 3 * self.size), nn.Linear(self.size, 3 * self.size)
        for linear, kind in ((self.of_input, "ih"), (self.of_state, "hh")):
            linear.load_state_dict({name: getattr(memory, f"{name}_{kind}_l{number}") for name in ("weight", "bias")})

    def forward(self, x: Tensor, state: Tensor) -> Tensor:
        sizes = [2 * self.size, self.size]
        (x_gates, x_new), (state_gates, state_new) = (
            self.of_input(x).split(sizes, -1),
            self.of_state(state).split(sizes, -1),
        )
        reset, update = torch.sigmoid(x_gates + state_gates).split(self.size, -1)
        new = torch.tanh(x_new + reset * state_new)
        return new + update * (state - new)


def _beside(*features: Tensor) -> Tensor:
    """Features (1, n, bands) of this frame and the one before to one (1, sum of n, 1, bands)."""
    return torch.cat(features, 1).unsqueeze(2)
