"""From a checkpoint to a file that the runtime accepts, and every way in which a wrong file must not get that far."""

import importlib.util
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from scipy.special import logit

from edgefilter import enhance
from edgefilter.engines.crnn import FADE, LOUD, Crnn, Level
from edgefilter.engines.onnx_session import open_session
from edgefilter.engines.paper_crnn import PaperCrnn as PaperEngine
from edgefilter.errors import ModelError
from edgefilter.types import Frame
from export import onnx_export, onnx_parity
from export.edge_graph import EdgeGraph
from export.network import EdgeConfig, EdgeCrnn
from export.onnx_export import Trained, export, load, main
from export.paper_network import PaperConfig, PaperCrnn

DATA = Path(__file__).parents[1] / "data"
EDGE = EdgeConfig(n_fft=320, hop=160, channels=(2, 2, 2, 2), hidden=5)
PAPER = PaperConfig(filters=(1,) * 8, lstm=2, hidden=4)


def edge(seed: int = 1) -> EdgeCrnn:
    """A small network none of whose biases is zero."""
    torch.manual_seed(seed)
    network = EdgeCrnn(EDGE).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return network


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> tuple[EdgeCrnn, Path]:
    """A network and the file that the command makes of its checkpoint."""
    folder = tmp_path_factory.mktemp("model")
    network = edge()
    checkpoint = {
        "network": network.state_dict(),
        "config": asdict(EDGE),
        "figures": {"si_sdr_db": 1.5},
        "data": "none",
        "seed": 1,
    }
    torch.save(checkpoint, folder / "last.pt")
    (folder / "figures.json").write_text(json.dumps({"wer": 0.3}))
    words = [folder / "last.pt", "--output", folder / "crnn.onnx", "--int8", "--figures", folder / "figures.json"]
    assert main([str(word) for word in words]) == 0
    return network, folder / "crnn.onnx"


@pytest.mark.slow
def test_the_runtime_takes_the_file_and_knows_its_stft_training_and_figures(exported):
    engine = Crnn(exported[1])
    assert engine.stft == EDGE.stft
    assert engine.model.training == {"data": "none", "seed": 1}
    assert engine.model.figures == {"si_sdr_db": 1.5, "wer": 0.3}
    assert [shape for _, shape in engine.model.states] == [
        tuple(tensor.shape) for tensor in exported[0].initial_state()
    ]


@pytest.mark.slow
def test_the_speech_head_is_scaled_as_asked_and_the_file_says_so(exported, tmp_path, capsys):
    network, path = exported
    words = [path.with_name("last.pt"), "--output", tmp_path / "crnn.onnx", "--platt", "0.5", "1.5"]
    assert main([str(word) for word in words]) == 0
    engines = Crnn(path), Crnn(tmp_path / "crnn.onnx")
    assert engines[1].model.training["platt"] == [0.5, 1.5]
    rng, bins = np.random.default_rng(2), engines[0].stft.bins
    spectra = (rng.standard_normal((4, bins)) + 1j * rng.standard_normal((4, bins))).astype(np.complex64)
    frame = Frame(*spectra, *rng.random((2, bins), np.float32))
    (usual, _), (scaled, _) = (engine.step(frame, engine.initial_state()) for engine in engines)
    np.testing.assert_array_equal(usual.spectrum, scaled.spectrum)
    assert logit(scaled.speech_probability) == pytest.approx(0.5 * logit(usual.speech_probability) + 1.5, abs=1e-4)
    capsys.readouterr()
    for given, complaint in ((["0", "1"], "scale above 0"), (["1", "inf"], "and a bias")):
        assert main([str(word) for word in [*words[:-2], *given]]) == 1
        assert complaint in capsys.readouterr().err


def test_nothing_but_the_model_is_left_behind(exported):
    assert sorted(path.name for path in exported[1].parent.iterdir()) == [
        "crnn.onnx",
        "crnn_int8.onnx",
        "figures.json",
        "last.pt",
    ]


def test_the_graph_is_opset_17_and_its_gru_is_torchs(exported):
    model = onnx.load(exported[1])
    assert [(opset.domain, opset.version) for opset in model.opset_import] == [("", 17)]
    grus = [node for node in model.graph.node if node.op_type == "GRU"]
    assert len(grus) == EDGE.layers
    for node in grus:
        assert {a.name: a.i for a in node.attribute}["linear_before_reset"] == 1
    assert exported[0].memory.bias_hh_l0.abs().min() > 0


def as_loud_as_in_training() -> tuple[Level, ...]:
    """Levels after which the engine scales the next frame by 1."""
    return tuple(Level(usual / FADE) for usual in LOUD)


def test_the_engine_computes_what_torch_computes(exported):
    network, path = exported
    engine = Crnn(path)
    rng = np.random.default_rng(3)
    ours, theirs = network.initial_state(), engine.initial_state()
    for _ in range(20):
        error, mic, reference, echo = (rng.standard_normal((4, engine.stft.bins, 2)) @ (1, 1j)).astype(np.complex64)
        noise, residual = rng.random((2, engine.stft.bins)).astype(np.float32)
        pairs = [torch.view_as_real(torch.from_numpy(x))[None] for x in (error, mic, reference, echo)]
        powers = [torch.from_numpy(x)[None] for x in (noise, residual)]
        with torch.no_grad():
            listen, recognise, probability, ours = network.step(*pairs, *powers, ours)
        heard = Frame(mic, reference, echo, error, noise, residual, idle=True)
        theirs = theirs[:2] + (as_loud_as_in_training(),)
        output, theirs = engine.step(heard, theirs)
        # 1e-4: the bound of the export, on values of about 1
        for found, wanted in ((output.spectrum, listen), (output.recognise, recognise)):
            np.testing.assert_allclose(found, torch.view_as_complex(wanted)[0].numpy(), atol=1e-4)
        assert np.abs(output.recognise - output.spectrum).max() > 0.01
        assert output.speech_probability == pytest.approx(float(probability[0]), abs=1e-4)
    for mine, found in zip(ours, theirs[0], strict=True):
        np.testing.assert_allclose(found, mine.numpy(), atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("norm", "erb"), [("layer", 0), ("batch", 0), ("none", 0), ("layer", 32)])
@pytest.mark.parametrize("products", [False, True])
def test_the_rewritten_graph_answers_like_the_network_whatever_its_shape(norm, erb, products):
    torch.manual_seed(4)
    shape = {"channels": (3, 4, 5, 6), "hidden": 7, "layers": 3, "norm": norm, "erb": erb}
    network = EdgeCrnn(EdgeConfig(n_fft=512, hop=256, **shape)).eval()
    for last in (network.mask, network.recognise[-1]):
        torch.nn.init.normal_(last.weight)
    state = [torch.rand_like(tensor) for tensor in network.initial_state()]
    spectra = [10.0 ** torch.empty(1, 257, 1).uniform_(-6, 0) * torch.randn(1, 257, 2) for _ in range(4)]
    powers = [10.0 ** torch.empty(1, 257).uniform_(-9, 0) for _ in range(2)]
    with torch.no_grad():
        *answers, following = network.step(*spectra, *powers, tuple(state))
        found = EdgeGraph(network, products)(*spectra, *powers, *state)
    for wanted, tensor in zip((*answers, *following), found, strict=True):
        torch.testing.assert_close(tensor, wanted, atol=1e-5, rtol=1e-5)


def test_the_int8_variant_is_taken_by_the_engine_and_answers_nearly_the_same(exported):
    small = exported[1].with_name("crnn_int8.onnx")
    operators = {node.op_type for node in onnx.load(small).graph.node}
    assert "MatMulInteger" in operators and "GRU" not in operators and "MatMul" not in operators
    engines = Crnn(exported[1]), Crnn(small)
    assert engines[1].model.describe() == {**engines[0].model.describe(), "file": str(small)}
    rng = np.random.default_rng(5)
    nothing = np.zeros(engines[0].stft.bins, np.float32)
    states = [engine.initial_state() for engine in engines]
    power = apart = 0.0
    for _ in range(50):
        frame = Frame(
            *(rng.standard_normal((4, engines[0].stft.bins, 2)) @ (1, 1j)).astype(np.complex64), nothing, nothing
        )
        (wanted, states[0]), (found, states[1]) = (engine.step(frame, state) for engine, state in zip(engines, states))
        power += np.sum(np.abs(wanted.spectrum) ** 2)
        apart += np.sum(np.abs(found.spectrum - wanted.spectrum) ** 2)
    assert 0 < apart < 1e-3 * power, "30 dB: seven bits of weight and eight of input in five units of memory"


def test_parity_runs_a_thousand_frames_and_is_far_below_the_bound(exported):
    assert onnx_parity.FRAMES == 1000 and onnx_parity.TOLERANCE == 1e-4
    assert 0 < onnx_parity.edge(exported[0], exported[1], frames=200) < 2e-5


@pytest.mark.slow
def test_parity_sees_a_weight_that_is_off_by_a_little(exported):
    other = edge()
    with torch.no_grad():
        other.memory.bias_hh_l0[0] += 0.02
    with pytest.raises(ModelError, match="expected at most 1e-04: not written"):
        onnx_parity.edge(other, exported[1], frames=200)


def test_parity_compares_the_state_too(exported):
    """Answers are right and the state handed on is not: that shows only later, and must not pass."""
    network = edge()

    def step(*inputs):
        *answers, (*others, hidden) = EdgeCrnn.step(network, *inputs)
        return *answers, (*others, hidden + 1e-3)

    network.step = step
    with pytest.raises(ModelError, match="not written"):
        onnx_parity.edge(network, exported[1], frames=1)


@pytest.mark.slow
def test_an_int8_variant_that_is_too_far_away_is_not_written(exported, monkeypatch, tmp_path):
    monkeypatch.setattr(onnx_parity, "FRAMES", 50)
    monkeypatch.setattr(onnx_parity, "LEAST_DB", 300.0)
    with pytest.raises(ModelError, match="expected at least 300 dB: not written"):
        export(Trained(exported[0]), tmp_path / "crnn.onnx", int8=True)
    assert [path.name for path in tmp_path.iterdir()] == ["crnn.onnx"]


def test_a_failed_export_leaves_the_old_file(exported, tmp_path, monkeypatch):
    path = tmp_path / "crnn.onnx"
    path.write_text("old")
    monkeypatch.setattr(onnx_parity, "FRAMES", 10)
    monkeypatch.setattr(onnx_parity, "TOLERANCE", 0.0)
    with pytest.raises(ModelError, match="not written"):
        export(Trained(exported[0]), path)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_network_that_does_not_fit_12_mb_is_refused(exported, tmp_path, monkeypatch):
    assert onnx_export.MAX_EDGE_BYTES == 12_000_000
    monkeypatch.setattr(onnx_export, "MAX_EDGE_BYTES", 10_000)
    monkeypatch.setattr(onnx_parity, "FRAMES", 10)
    with pytest.raises(ModelError, match="expected at most 0 MB: train a smaller one"):
        export(Trained(exported[0]), tmp_path / "crnn.onnx")


def test_a_start_that_is_not_silence_is_refused(tmp_path):
    network = edge()
    network.initial_state = lambda: tuple(tensor + 1 for tensor in EdgeCrnn.initial_state(network))
    with pytest.raises(ModelError, match="not all zeros"):
        export(Trained(network), tmp_path / "crnn.onnx")


@pytest.mark.parametrize(
    "content",
    [
        b"text",
        None,
        {"network": {}},
        {"kind": "lstm", "config": {}, "network": {}},
        {"config": {"size": 3}, "network": {}},
        {"config": {}, "network": {}},
    ],
)
def test_what_is_no_checkpoint_is_refused_in_one_line(tmp_path, capsys, content):
    path = tmp_path / "last.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        torch.save(content, path)
    assert main([str(path), "--output", str(tmp_path / "crnn.onnx")]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "that training wrote" in said
    assert not (tmp_path / "crnn.onnx").exists()


@pytest.mark.slow
def test_the_papers_network_is_exported_for_clips_of_any_length_and_with_an_int8_lstm(tmp_path):
    torch.manual_seed(2)
    network = PaperCrnn(PAPER).eval()
    torch.save({"kind": "paper", "config": asdict(PAPER), "network": network.state_dict()}, tmp_path / "paper.pt")
    lines = export(load(tmp_path / "paper.pt"), tmp_path / "paper.onnx", int8=True)
    assert "from torch at most" in lines[0] and "paper_int8.onnx" in lines[1] and len(lines) == 2
    small = tmp_path / "paper_int8.onnx"
    assert small.stat().st_size < 0.75 * (tmp_path / "paper.onnx").stat().st_size
    assert "DynamicQuantizeLSTM" in {node.op_type for node in onnx.load(small).graph.node}
    for path, bound in ((tmp_path / "paper.onnx", 1e-4), (small, 0.05)):  # int8: eight bits of weights and of inputs
        assert PaperEngine(path).model.stft.bins == 601
        for frames in (3, 70):
            mic, reference = np.abs(np.random.default_rng(frames).standard_normal((2, 1, frames, 601))).astype(
                np.float32
            )
            found = open_session(path).run(None, {"mic_magnitude": mic, "reference_magnitude": reference})[0]
            with torch.no_grad():
                wanted = network(torch.from_numpy(mic), torch.from_numpy(reference)).numpy()
            assert np.max(np.abs(found - wanted)) < bound


def test_a_narrower_network_says_its_sizes_and_the_engine_runs_it(tmp_path, monkeypatch, capsys):
    torch.manual_seed(3)
    config = PaperConfig(filters=(3,) * 7 + (2,), lstm=4, hidden=5)
    state = {"kind": "paper", "config": asdict(config), "network": PaperCrnn(config).state_dict(), "step": 7}
    torch.save(state, tmp_path / "best.pt")
    path = tmp_path / "narrow.onnx"
    assert main([str(tmp_path / "best.pt"), "--output", str(path)]) == 0
    capsys.readouterr()
    sizes = {"bins": 601, "filters": [3] * 7 + [2], "lstm": 4, "hidden": 5, "batch_norm": False}
    count = sum(value.numel() for value in state["network"].values())
    mic, reference = np.random.default_rng(0).standard_normal((2, 3200)).astype(np.float32)
    given = enhance(mic, reference, engine="paper-crnn", model=path)
    model = PaperEngine(path).model
    said = model.session.get_modelmeta().custom_metadata_map["network"]
    assert model.training == {"step": 7} and json.loads(said) == sizes | {"parameters": count}
    monkeypatch.setenv("EDGEFILTER_PAPER_CRNN", str(path))
    assert PaperEngine().model.path == path
    named = enhance(mic, reference, engine="paper-crnn")
    np.testing.assert_array_equal(given, named)
    assert given.shape == mic.shape and 0 < np.sum(given**2) < np.sum(mic**2)


def test_the_test_models_are_what_their_script_makes(tmp_path):
    spec = importlib.util.spec_from_file_location("make_models", DATA / "make_models.py")
    make_models = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_models)
    assert onnx_parity.edge(make_models.tiny_edge(), DATA / "crnn.onnx", frames=20) < 1e-4
    assert onnx_parity.paper(make_models.tiny_paper(), DATA / "paper_crnn.onnx") < 1e-4
