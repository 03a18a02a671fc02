"""Make tests/data/crnn.onnx and paper_crnn.onnx: real networks of the smallest size, untrained, for the tests of loading and running.

python -m tests.data.make_models

They are pure functions of the seed: the weights are random, nothing was trained on anything.
"""

from __future__ import annotations

from pathlib import Path

import torch

from export.network import EdgeConfig, EdgeCrnn
from export.onnx_export import Trained, export
from export.paper_network import PaperConfig, PaperCrnn

DATA = Path(__file__).parent
TRAINING = {"data": "none: random weights", "seed": 0}


def tiny_edge() -> EdgeCrnn:
    """The edge network with as few channels as it takes, and corrections that are not zero."""
    torch.manual_seed(0)
    network = EdgeCrnn(EdgeConfig(channels=(2, 2, 2, 2), hidden=6)).eval()
    for last in (network.mask, network.recognise[-1]):
        torch.nn.init.normal_(last.weight)
    return network


def tiny_paper() -> PaperCrnn:
    """The paper's network with one filter a layer."""
    torch.manual_seed(0)
    return PaperCrnn(PaperConfig(filters=(1,) * 8, lstm=2, hidden=8)).eval()


if __name__ == "__main__":
    for name, network in (("crnn.onnx", tiny_edge()), ("paper_crnn.onnx", tiny_paper())):
        print(*export(Trained(network, TRAINING), DATA / name), sep="\n")
