"""Convert a trained network to the ONNX file that the runtime loads, and prove that both compute the same.

python -m export.onnx_export CHECKPOINT --output models/crnn.onnx [--int8] [--platt SCALE BIAS] [--figures FIGURES.json]

A checkpoint is what torch.save made of a dict: network (a state_dict), config (the fields of its configuration),
figures (what it reached on validation data) and kind ("edge", also where it is missing, "paper", or "voicefilter", of which
export/voicefilter.py writes the file); all else in it says how it was trained, and goes into the file's metadata like the
figures; of the paper's network, which there is in several widths, its sizes go there as well. The file is written only once
the ONNX checker, the parity test and the size limit have passed; otherwise ModelError says which failed.
"""

from __future__ import annotations

import argparse
import copy
import json
import logging
import math
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.crnn import EDGE_TYPE, EDGE_VERSION, POWERS, SOUNDS, SPECTRA
from edgefilter.engines.paper_crnn import PAPER_TYPE, PAPER_VERSION
from edgefilter.engines.paper_ss import PAPER_STFT
from edgefilter.errors import EdgefilterError, ModelError
from edgefilter.types import SAMPLE_RATE
from export import onnx_parity
from export.edge_graph import EdgeGraph
from export.network import EdgeConfig, EdgeCrnn
from export.paper_network import PaperConfig, PaperCrnn, parameter_count
from export.voicefilter_network import VoiceFilter, VoiceFilterConfig

OPSET = 17
MAX_EDGE_BYTES = 12_000_000
"""The runtime's model has to fit a robot's disk and caches."""


@dataclass(frozen=True)
class Trained:
    """A network in evaluation mode, with what its file will say about its training and its figures."""

    network: nn.Module
    training: Mapping[str, object] = field(default_factory=dict)
    figures: Mapping[str, object] = field(default_factory=dict)


def load(path: Path) -> Trained:
    """The network that a checkpoint holds; raises ModelError where it holds none."""
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
        make = {
            "edge": lambda c: EdgeCrnn(EdgeConfig(**c)),
            "paper": lambda c: PaperCrnn(PaperConfig(**c)),
            "voicefilter": lambda c: VoiceFilter(VoiceFilterConfig(**c)),
        }[found.get("kind", "edge")]
        network = make(found["config"])
        # trained before there was a second sound: it is the first
        second = {name: value for name, value in network.state_dict().items() if name.startswith("recognise.")}
        network.load_state_dict(second | found["network"])
    except OSError as error:
        raise ModelError(f"{path}: {error.strerror}; give a checkpoint that training wrote") from None
    except Exception as error:
        raise ModelError(
            f"{path} is no checkpoint of a network ({' '.join(str(error).split())[:120]}): give one that training wrote"
        ) from None
    training = {
        key: value for key, value in found.items() if key not in ("network", "config", "kind", "figures", "resume")
    }
    return Trained(network.eval(), training, found.get("figures", {}))


def scaled(trained: Trained, scale: float, bias: float) -> Trained:
    """The network whose speech head's log-odds are scale times what they were, plus bias (Platt 1999).

    Raises ModelError for a network without such a head, and for a scale that is not positive.
    """
    if not isinstance(trained.network, EdgeCrnn):
        raise ModelError("the paper's network judges no speech: leave out --platt")
    if not (0.0 < scale < math.inf and math.isfinite(bias)):
        raise ModelError(f"--platt is {scale:g} {bias:g}, expected a scale above 0 and a bias")
    network = copy.deepcopy(trained.network)
    with torch.no_grad():
        network.speech.weight.mul_(scale)
        network.speech.bias.mul_(scale).add_(bias)
    return replace(trained, network=network, training={**trained.training, "platt": [scale, bias]})


def export(trained: Trained, path: Path, int8: bool = False) -> list[str]:
    """Write the network to path, and with int8 a smaller and faster variant beside it.

    Return what was done, a line a file.
    """
    write, compare = (
        (_write_paper, onnx_parity.paper) if isinstance(trained.network, PaperCrnn) else (_write_edge, onnx_parity.edge)
    )
    with in_place_of(path) as unproven:
        write(trained, unproven)
        apart = compare(trained.network, unproven)
        _check_size(trained.network, unproven)
    lines = [f"{path}: {path.stat().st_size / 1e6:.2f} MB, {apart:.1e} from torch at most"]
    if int8:
        lines.append(_write_int8(trained, path))
    return lines


@contextmanager
def in_place_of(path: Path) -> Iterator[Path]:
    """A file to write, which takes the path's place where nothing fails, and is gone otherwise."""
    unproven = path.with_name(f".{path.name}.unproven")
    try:
        yield unproven
        os.replace(unproven, path)
    finally:
        unproven.unlink(missing_ok=True)


def _write_edge(trained: Trained, path: Path, products: bool = False) -> None:
    network = trained.network
    state = network.initial_state()
    if any(tensor.any() for tensor in state):
        raise ModelError("the network's initial state is not all zeros, which is what the runtime starts from")
    config = network.config
    stft = StftConfig(config.n_fft, config.hop, config.n_fft, config.window)
    # one tensor object per input: the exporter would merge inputs that are the same object
    powers = [torch.rand(1, stft.bins) for _ in POWERS]
    inputs = [*(torch.randn(1, stft.bins, 2) for _ in SPECTRA), *powers, *map(torch.randn_like, state)]
    names = [f"state_{i}" for i in range(len(state))]
    trace(
        EdgeGraph(network, products).eval(),
        inputs,
        path,
        [*SPECTRA, *POWERS, *names],
        [*SOUNDS, "speech_probability", *(f"next_{name}" for name in names)],
    )
    states = [[name, list(tensor.shape)] for name, tensor in zip(names, state)]
    describe(path, EDGE_TYPE, EDGE_VERSION, stft, trained, states=json.dumps(states))


def _write_paper(trained: Trained, path: Path) -> None:
    network = trained.network
    if network.config.bins != PAPER_STFT.bins:
        raise ModelError(
            f"the paper's network has {network.config.bins} bins, its runtime {PAPER_STFT.bins}: train it on"
            f" {PAPER_STFT.bins}"
        )
    inputs = [torch.rand(1, 50, network.config.bins) for _ in range(2)]
    names = ["mic_magnitude", "reference_magnitude"]
    trace(network, inputs, path, names, ["mask"], {name: {1: "frames"} for name in (*names, "mask")})
    sizes = asdict(network.config) | {"parameters": parameter_count(network)}
    describe(path, PAPER_TYPE, PAPER_VERSION, PAPER_STFT, trained, network=json.dumps(sizes))


def trace(
    network: nn.Module,
    inputs: Sequence[Tensor],
    path: Path,
    names: list[str],
    outputs: list[str],
    dynamic: dict | None = None,
) -> None:
    """Write the network's graph for these inputs by torch's tracing exporter.

    Dynamic axes as torch.onnx.export wants them.
    """
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter(
            "ignore"
        )  # the exporter warns of its own age and of shapes, all of which are fixed or tested here
        torch.onnx.export(
            network,
            tuple(inputs),
            str(path),
            input_names=names,
            output_names=outputs,
            dynamic_axes=dynamic,
            opset_version=OPSET,
            dynamo=False,
        )


def describe(path: Path, kind: str, version: int, stft: StftConfig, trained: Trained, **more: str) -> None:
    """Put the metadata into the file that the runtime checks, and run the ONNX checker over it."""
    model = onnx.load(str(path))
    metadata = {
        "type": kind,
        "version": str(version),
        "sample_rate": str(SAMPLE_RATE),
        "n_fft": str(stft.n_fft),
        "hop": str(stft.hop),
        "window_length": str(stft.window_length),
        "window": stft.window,
        "training": json.dumps(trained.training),
        "figures": json.dumps(trained.figures),
        **more,
    }
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))


def _check_size(network: nn.Module, path: Path) -> None:
    size = path.stat().st_size
    if not isinstance(network, PaperCrnn) and size > MAX_EDGE_BYTES:
        raise ModelError(
            f"the network takes {size / 1e6:.1f} MB, expected at most {MAX_EDGE_BYTES / 1e6:.0f} MB: train a"
            " smaller one"
        )


def _write_int8(trained: Trained, path: Path) -> str:
    """The variant with int8 weights of the recurrent layer, where most of a network's weights are.

    onnxruntime has an int8 LSTM; an edge network's GRU is written as matrix products first, and its linear layers go
    with it. Those get seven bits, an int8 product of eight overflows on processors without VNNI; convolutions stay
    fp32.
    """
    from onnxruntime.quantization import QuantType, quantize_dynamic

    network, small = trained.network, path.with_name(f"{path.stem}_int8.onnx")
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        source, unproven = path, Path(folder, small.name)
        kinds: dict[str, object] = {"op_types_to_quantize": ["LSTM"]}
        if not isinstance(network, PaperCrnn):
            source = Path(folder, "products.onnx")
            _write_edge(trained, source, products=True)
            kinds = {"op_types_to_quantize": ["MatMul"], "per_channel": True, "reduce_range": True}
        with _without_advice():
            quantize_dynamic(str(source), str(unproven), weight_type=QuantType.QInt8, **kinds)
        apart = onnx_parity.int8(network, unproven)
        before, after = onnx_parity.seconds(network, path), onnx_parity.seconds(network, unproven)
        os.replace(unproven, small)
    return f"{small}: {small.stat().st_size / 1e6:.2f} MB, {apart}, {after / before:.2f} of the fp32 file's time"


@contextmanager
def _without_advice() -> Iterator[None]:
    """The quantiser recommends a pre-processing that changes nothing for a traced graph, by the root logger."""
    root = logging.getLogger()
    before = root.level
    root.setLevel(logging.ERROR)
    try:
        yield
    finally:
        root.setLevel(before)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m export.onnx_export",
        description="Convert a trained network to the ONNX file that the runtime loads.",
    )
    parser.add_argument("checkpoint", type=Path, help="best.pt of export/train.py")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.onnx")
    parser.add_argument(
        "--int8", action="store_true", help="also write FILE_int8.onnx, with int8 weights of the recurrent layer"
    )
    parser.add_argument(
        "--figures", type=Path, metavar="FILE.json", help="figures to write into the file, over those of the checkpoint"
    )
    parser.add_argument(
        "--platt",
        type=float,
        nargs=2,
        metavar=("SCALE", "BIAS"),
        help="of the speech head's log-odds, as `python -m bench training probability` finds them",
    )
    options = parser.parse_args(argv)
    try:
        trained = load(options.checkpoint)
        if options.figures:
            trained = replace(trained, figures={**trained.figures, **json.loads(options.figures.read_text())})
        if options.platt:
            trained = scaled(trained, *options.platt)
        print("\n".join(export(trained, options.output, options.int8)))
    except (EdgefilterError, OSError, ValueError) as error:
        print(f"export: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
