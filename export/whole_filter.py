"""One ONNX graph for the whole filter behind the alignment: STFT, linear stage, network, inverse STFT, with explicit state.

python -m export.whole_filter --model models/crnn.onnx --output models/whole_filter.onnx [--taps 6400]

Any language with onnxruntime can run it, one hop at a time: docs/whole_filter_example.py. A second file, NAME_start.onnx, turns an
impulse response (taps,), all zeros for a robot that was not calibrated, into the state to begin with; each output next_X of the
filter is the next hop's input X. The reference has to come in aligned: sample by sample as the loudspeaker played it, delayed to
where the impulse response expects it.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import onnx
import torch
from onnx import compose

from edgefilter.engines.crnn import EDGE_TYPE, EDGE_VERSION, SPECTRA
from edgefilter.engines.onnx_session import Model, open_model
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE
from export.onnx_export import trace
from export.whole_filter_graph import FRONT_STATES, Back, Front, Start

TYPE, VERSION = "edgefilter-whole-filter", 1
TAPS = 6400


def build(network: Model, output: Path, taps: int = TAPS) -> tuple[Path, Path]:
    """Write the filter around an edge network to output, and NAME_start.onnx beside it; return both paths.

    taps: length of the linear stage, rounded up to whole hops.
    """
    stft = network.stft
    front, back = Front(stft, taps).eval(), Back(stft).eval()
    overlap = (stft.window_length - stft.hop,)
    others = {"overlap": overlap, **{f"crnn_{name}": shape for name, shape in network.states}}
    start = Start(front, tuple(others.values())).eval()
    first = output.with_name(f"{output.stem}_start.onnx")
    impulse_response = torch.zeros(front.partitions * front.hop)
    names = [*FRONT_STATES, *others]
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        trace(start, [impulse_response], first, ["impulse_response"], names)
        states = start(impulse_response)
        signals = [torch.randn(stft.hop) for _ in range(2)]
        heard = [f"front_{name}" for name in SPECTRA]
        ends = Path(folder, "front.onnx"), Path(folder, "back.onnx")
        front_states = [tensor.clone() for tensor in states[: len(FRONT_STATES)]]
        following = [f"next_{name}" for name in FRONT_STATES]
        trace(front, [*signals, *front_states], ends[0], ["mic", "reference", *FRONT_STATES], [*heard, *following])
        trace(back, [torch.randn(1, stft.bins, 2), torch.zeros(overlap)], ends[1], ["spectrum", "overlap"], ["human", "next_overlap"])
        merged = _merge(onnx.load(str(ends[0])), onnx.load(str(network.path)), onnx.load(str(ends[1])), ["human", "speech_probability"], names)
    shapes = [[name, list(tensor.shape)] for name, tensor in zip(names, states)]
    for model, path in ((onnx.load(str(first)), first), (merged, output)):
        _describe(model, network, impulse_response.numel(), shapes)
        onnx.save(model, str(path))
    return output, first


def _merge(front: onnx.ModelProto, network: onnx.ModelProto, back: onnx.ModelProto, outputs: list[str], states: list[str]) -> onnx.ModelProto:
    """The three graphs as one, with outputs first and then each state's successor, in order."""
    front, back = (
        compose.add_prefix(end, prefix, rename_inputs=False, rename_outputs=False) for end, prefix in ((front, "front/"), (back, "back/"))
    )
    network = compose.add_prefix(network, "crnn_")
    merged = compose.merge_models(front, network, [(f"front_{name}", f"crnn_{name}") for name in SPECTRA])
    merged = compose.merge_models(merged, back, [("crnn_spectrum", "spectrum")])
    new = {"crnn_speech_probability": "speech_probability"}
    new |= {f"crnn_next_{name.removeprefix('crnn_')}": f"next_{name}" for name in states if name.startswith("crnn_")}
    for node in merged.graph.node:
        for names in (node.input, node.output):
            names[:] = [new.get(name, name) for name in names]
    for slot in merged.graph.output:
        slot.name = new.get(slot.name, slot.name)
    wanted = [*outputs, *(f"next_{name}" for name in states)]
    slots = sorted(merged.graph.output, key=lambda slot: wanted.index(slot.name))
    del merged.graph.output[:]
    merged.graph.output.extend(slots)
    return merged


def _describe(model: onnx.ModelProto, network: Model, taps: int, states: list) -> None:
    metadata = {
        "type": TYPE,
        "version": str(VERSION),
        "sample_rate": str(SAMPLE_RATE),
        "hop": str(network.stft.hop),
        "latency": str(network.stft.window_length),
        "taps": str(taps),
        "states": json.dumps(states),
        "training": json.dumps(network.training),
        "figures": json.dumps(network.figures),
    }
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m export.whole_filter", description="Put the whole filter behind the alignment into one ONNX file.")
    parser.add_argument("--model", type=Path, required=True, metavar="CRNN.onnx", help="edge network, made by export/onnx_export.py")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.onnx")
    parser.add_argument("--taps", type=int, default=TAPS, help="length of the linear stage in samples (default: %(default)s)")
    options = parser.parse_args(argv)
    try:
        for path in build(open_model(options.model, EDGE_TYPE, EDGE_VERSION), options.output, options.taps):
            print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    except (EdgefilterError, OSError) as error:
        print(f"export: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
