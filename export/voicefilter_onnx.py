"""A trained VoiceFilter as an ONNX file with its weights as float16, and the proof that it computes what torch does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import helper, numpy_helper
from torch import nn

from edgefilter.errors import ModelError
from export.onnx_export import Trained, describe, in_place_of, trace

TYPE, VERSION = "edgefilter-voicefilter", 1
"""What the file's metadata says; who loads it checks that."""
TOLERANCE = 1e-3
"""Largest difference of a mask between torch and the file, the weights rounded in both: what onnxruntime's LSTM takes for
tanh differs by some 1e-5 a frame, and adds up."""
LARGE = 1024
"""Values from which on a weight is kept as float16; below, it stays as it is."""


@torch.no_grad()
def rounded(trained: Trained) -> Trained:
    """The same with its large weights as they are in the file, in place."""
    for weight in trained.network.parameters():
        if weight.numel() >= LARGE:
            weight.copy_(weight.half().float())
    return trained


def export(trained: Trained, path: Path) -> str:
    """Write the network, whose weights rounded() has seen, to path; returns what was done.

    Raises ModelError, and leaves path as it is, where the file differs from the network by more than TOLERANCE.
    """
    network = trained.network
    with in_place_of(path) as unproven:
        bins, values = network.config.stft.bins, network.config.d_vector
        inputs = [torch.rand(1, 50, bins), torch.randn(1, values)]
        frames = {name: {1: "frames"} for name in ("magnitude", "mask")}
        trace(network, inputs, unproven, ["magnitude", "d_vector"], ["mask"], frames)
        _halve(unproven)
        describe(unproven, TYPE, VERSION, network.config.stft, trained)
        apart = _difference(network, unproven)
        if not apart <= TOLERANCE:
            raise ModelError(
                f"{path.name} differs from torch by {apart:.1e}, expected at most {TOLERANCE}: not written"
            )
    return f"{path}: {path.stat().st_size / 1e6:.2f} MB, {apart:.1e} from torch at most"


def _halve(path: Path) -> None:
    """Keep large weights as float16, each with a Cast behind it that onnxruntime folds away on loading."""
    model = onnx.load(str(path))
    casts = []
    for weight in model.graph.initializer:
        values = numpy_helper.to_array(weight)
        if values.dtype != np.float32 or values.size < LARGE:
            continue
        stored = f"{weight.name}_half"
        casts.append(helper.make_node("Cast", [stored], [weight.name], to=onnx.TensorProto.FLOAT))
        weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), stored))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.save(model, str(path))


@torch.no_grad()
def _difference(network: nn.Module, path: Path) -> float:
    """Largest difference of the mask over clips of other lengths than the traced one."""
    session, apart = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"]), 0.0
    noise = torch.Generator().manual_seed(0)
    for frames in (1, 40, 200):
        magnitude = torch.rand(1, frames, network.config.stft.bins, generator=noise)
        told = torch.randn(1, network.config.d_vector, generator=noise)
        mask = session.run(None, {"magnitude": magnitude.numpy(), "d_vector": told.numpy()})[0]
        apart = max(apart, float(np.abs(mask - network(magnitude, told).numpy()).max()))
    return apart
