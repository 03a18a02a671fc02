"""Edge networks of several sizes with random weights, for the curve of cost over size.

What a frame costs does not depend on the weights.

    python -m bench.measure.latency_networks --output DIR                   (needs the export extra)
    python -m bench.measure.latency --models DIR/*_int8.onnx --output bench/results/latency

Of each there is the fp32 file and the int8 variant, which is what the engine runs.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from export.network import EdgeConfig, EdgeCrnn
from export.onnx_export import Trained, export

WIDTHS = (0.25, 0.5, 0.75, 1.0, 1.5)
"""Factors on the channels and the GRU of the network as it is trained."""


def widened(factor: float) -> EdgeConfig:
    """The network's own shape, so many times as wide."""
    usual = EdgeConfig()
    return replace(
        usual,
        channels=tuple(max(2, round(factor * c)) for c in usual.channels),
        hidden=max(8, round(factor * usual.hidden)),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for width in WIDTHS:
        torch.manual_seed(0)
        print(
            *export(
                Trained(EdgeCrnn(widened(width)).eval(), {"data": "none: random weights"}),
                args.output / f"crnn_{width:g}.onnx",
                int8=True,
            ),
            sep="\n",
        )


if __name__ == "__main__":
    main()
