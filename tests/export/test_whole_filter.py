"""The whole filter as one graph equals the Python stream, alignment aside, and runs with onnxruntime alone."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from edgefilter.alignment.delay_line import Aligned
from edgefilter.engines.crnn import EDGE_TYPE, EDGE_VERSION, Crnn
from edgefilter.engines.onnx_session import open_model, open_session
from edgefilter.filter.canceller import Canceller
from edgefilter.filter.stream import Stream
from export import onnx_parity
from export.network import EdgeConfig, EdgeCrnn
from export.onnx_export import Trained, export
from export.whole_filter import build, main

ROOT = Path(__file__).parents[2]
TAPS = 2000
PATH = (np.random.default_rng(5).standard_normal(TAPS) * np.exp(-np.arange(TAPS) / 150)).astype(np.float32) * 0.2
"""An echo path at the microphone, 125 ms long."""


class NoAlignment:
    """What stands for the aligner: the reference as it comes."""

    def step(self, mic: np.ndarray, ref: np.ndarray) -> Aligned:
        return Aligned(ref, 0.0, 0.0, 1.0, "locked", False)


class Watched(Canceller):
    """A canceller that remembers what it went through."""

    turned = phantom = 0

    def _follow_gain(self, mic, echo):
        before = self.gain
        echo = super()._follow_gain(mic, echo)
        self.turned += self.gain != before
        return echo

    def _without_phantom(self, mic, echo):
        echo, error, phantom = super()._without_phantom(mic, echo)
        self.phantom += phantom
        return echo, error, phantom


@pytest.fixture(scope="module", params=[256, 160])
def made(request, tmp_path_factory) -> tuple[Path, Path, Path]:
    """An edge network with this hop, the filter around it and its start."""
    folder = tmp_path_factory.mktemp("whole")
    network = ROOT / "tests/data/crnn.onnx"
    if request.param != 256:
        torch.manual_seed(0)
        network = folder / "crnn.onnx"
        tiny = EdgeCrnn(EdgeConfig(2 * request.param, request.param, channels=(2, 2, 2, 2), hidden=6)).eval()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(onnx_parity, "FRAMES", 10)
            export(Trained(tiny), network)
    return network, *build(open_model(network, EDGE_TYPE, EDGE_VERSION), folder / "filter.onnx", TAPS)


def conversation(seconds: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Robot, fan and a human who interrupts; the volume is turned on the way, and for half a second the robot is not heard at all."""
    rng = np.random.default_rng(6)
    n = int(16000 * seconds)
    reference = 0.1 * rng.standard_normal(n) * np.repeat(rng.uniform(size=n // 1600 + 1) > 0.2, 1600)[:n]
    echo = np.convolve(reference, PATH)[:n]
    echo[n // 2 :] *= 0.7
    echo[int(0.7 * n) : int(0.7 * n) + 8000] = 0.0
    human = 0.02 * np.sin(np.arange(n) * 0.2) * (np.arange(n) % 20000 > 12000)
    return (echo + human + 0.001 * rng.standard_normal(n)).astype(np.float32), reference.astype(np.float32)


def python_stream(network: Path, mic: np.ndarray, reference: np.ndarray, path: np.ndarray | None) -> tuple[np.ndarray, Watched]:
    stream = Stream(Crnn(network, wiener_share=0.0))
    stream.front.aligner = NoAlignment()
    stream.front.canceller = Watched(stream.engine.stft.hop, TAPS, path)
    return np.concatenate((stream.process(mic, reference), stream.flush())), stream.front.canceller


def run_graph(made: tuple[Path, Path, Path], mic: np.ndarray, reference: np.ndarray, path: np.ndarray) -> np.ndarray:
    step, start = open_session(made[1]), open_session(made[2])
    about = step.get_modelmeta().custom_metadata_map
    hop, latency, taps = (int(about[key]) for key in ("hop", "latency", "taps"))
    names = [name for name, _ in json.loads(about["states"])]
    state = start.run(names, {"impulse_response": np.pad(path, (0, taps - path.size)).astype(np.float32)})
    n = -(-(mic.size + latency) // hop) * hop
    mic_in, reference_in = (np.pad(x, (0, n - x.size)) for x in (mic, reference))
    out = []
    for at in range(0, n, hop):
        inputs = {"mic": mic_in[at : at + hop], "reference": reference_in[at : at + hop], **dict(zip(names, state))}
        human, _, *state = step.run(["human", "speech_probability", *(f"next_{name}" for name in names)], inputs)
        out.append(human)
    return np.concatenate(out)[latency - hop :][: mic.size]


@pytest.mark.parametrize("warm", [False, True])
def test_the_graph_equals_the_stream_through_all_that_the_linear_stage_does(made, warm):
    mic, reference = conversation()
    wanted, canceller = python_stream(made[0], mic, reference, PATH if warm else None)
    found = run_graph(made, mic, reference, PATH if warm else np.zeros(TAPS))
    assert canceller.turned > 0 and canceller.phantom > 3 and canceller.stats()["active_hops"] > 100
    assert np.abs(wanted).max() > 0.01
    # 1e-4: the promise; float32 sums in another order, fed back over some 200 hops
    np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_the_graph_answers_with_the_networks_probability(made):
    mic, reference = conversation(1.0)
    stream = Stream(Crnn(made[0], wiener_share=0.0))
    stream.front.aligner = NoAlignment()
    stream.front.canceller = Canceller(stream.engine.stft.hop, TAPS)
    step, start = open_session(made[1]), open_session(made[2])
    hop = stream.engine.stft.hop
    names = [slot.name for slot in start.get_outputs()]
    state = start.run(None, {"impulse_response": np.zeros(start.get_inputs()[0].shape[0], np.float32)})
    for at in range(0, mic.size - hop, hop):
        stream.process(mic[at : at + hop], reference[at : at + hop])
        _, probability, *state = step.run(None, {"mic": mic[at : at + hop], "reference": reference[at : at + hop], **dict(zip(names, state))})
        assert probability[0] == pytest.approx(stream.speech_probability, abs=1e-4)


def test_the_command_makes_both_files_and_refuses_a_file_that_is_no_edge_network(tmp_path, capsys):
    words = ["--model", str(ROOT / "tests/data/crnn.onnx"), "--output", str(tmp_path / "w.onnx"), "--taps", "700"]
    assert main(words) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["w.onnx", "w_start.onnx"]
    about = open_session(tmp_path / "w.onnx").get_modelmeta().custom_metadata_map
    assert about["taps"] == "768" and about["type"] == "edgefilter-whole-filter", "700 taps fill three hops of 256"
    assert main(["--model", str(ROOT / "tests/data/paper_crnn.onnx"), "--output", str(tmp_path / "p.onnx")]) == 1
    assert "expected edgefilter-crnn" in capsys.readouterr().err


def test_the_example_filters_files_with_onnxruntime_alone(made, tmp_path):
    example = ROOT / "docs/whole_filter_example.py"
    imported = {alias.name for node in ast.walk(ast.parse(example.read_text())) if isinstance(node, ast.Import) for alias in node.names}
    assert imported == {"json", "sys", "wave", "numpy", "onnxruntime"} and "from " not in example.read_text().split('"""')[2]
    mic, reference = conversation(1.2)
    for name, x in (("mic", mic), ("reference", reference)):
        soundfile.write(tmp_path / f"{name}.wav", x, 16000, "PCM_16")
    words = [made[1], "mic.wav", "reference.wav", "human.wav"]
    done = subprocess.run([sys.executable, str(example), *map(str, words)], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    heard = [soundfile.read(tmp_path / f"{name}.wav", dtype="float32")[0] for name in ("mic", "reference")]
    wanted, _ = python_stream(made[0], *heard, None)
    found = soundfile.read(tmp_path / "human.wav", dtype="float32")[0]
    assert found.shape == mic.shape
    # 1e-4 of the graph, and half a step of 16 bits
    np.testing.assert_allclose(found, np.clip(wanted, -1, 32767 / 32768), atol=1e-4 + 0.5 / 32768)
