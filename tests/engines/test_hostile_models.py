"""A model file is numbers and standard operators: nothing in it runs code, reads other files, or gives NaN."""

from __future__ import annotations

import hashlib
import json
import re

import hypothesis.strategies as st
import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from onnx import TensorProto

from edgefilter.engines import onnx_graph, onnx_session
from edgefilter.engines.crnn import LOUDEST, SURE, Crnn
from edgefilter.errors import ModelError
from edgefilter.types import Frame
from tests.program import ROOT

EDGE = ROOT / "tests" / "data" / "crnn.onnx"


def refused(path, words, capfd):
    with pytest.raises(ModelError, match=words) as caught:
        Crnn(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1200
    assert capfd.readouterr() == ("", "")  # '--output -' sends sound there


def outside(tensor, location, length=4):
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", str(length))):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value


def weights_beside_it(model):
    """In the working directory, in the right number: onnxruntime would take them."""
    weights = next(each for each in model.graph.initializer if each.name.endswith("norm.weight"))
    outside(weights, "weights", 4 * weights.dims[0])


def weights_said_to_be_elsewhere(model):
    outside(model.graph.initializer[0], "/etc/hostname")
    del model.graph.initializer[0].external_data[:]


def weights_that_are_no_numbers(model):
    weights = next(each for each in model.graph.initializer if len(each.dims) == 4)
    values = onnx.numpy_helper.to_array(weights).copy()
    values.flat[0] = np.nan
    weights.CopyFrom(onnx.numpy_helper.from_array(values, weights.name))


def says(key, value):
    def change(model):
        next(entry for entry in model.metadata_props if entry.key == key).value = value

    return change


def straight(kind, inputs, outputs):
    return onnx.helper.make_graph([onnx.helper.make_node(kind, inputs, outputs)], "within", [], [])


def flag(name):
    return onnx.helper.make_tensor_value_info(name, TensorProto.BOOL, ())


def number(name):
    return onnx.helper.make_tensor_value_info(name, TensorProto.FLOAT, ())


def loop_without_end(model):
    """2e12 rounds, of which the first answer needs the last: the engine is never there."""
    body = straight("Identity", ["go"], ["on"])
    body.node.append(onnx.helper.make_node("Neg", ["before"], ["after"]))
    body.input.extend(
        [onnx.helper.make_tensor_value_info("round", TensorProto.INT64, ()), flag("go"), number("before")]
    )
    body.output.extend([flag("on"), number("after")])
    for name, value in (("rounds", np.array(2 * 10**12)), ("yes", np.array(True)), ("zero", np.array(0, np.float32))):
        model.graph.initializer.append(onnx.numpy_helper.from_array(value, name))
    for node in model.graph.node:
        node.output[:] = ["raw" if name == "speech_probability" else name for name in node.output]
    model.graph.node.append(onnx.helper.make_node("Loop", ["rounds", "yes", "zero"], ["end"], body=body))
    model.graph.node.append(onnx.helper.make_node("Add", ["raw", "end"], ["speech_probability"]))


def branch(model):
    way = onnx.helper.make_graph([], "way", [], [flag("told")])
    model.graph.node.append(onnx.helper.make_node("If", ["yes"], ["told"], then_branch=way, else_branch=way))


def scan(model):
    body = straight("Identity", ["a"], ["b"])
    model.graph.node.append(onnx.helper.make_node("Scan", ["x"], ["y"], body=body, num_scan_inputs=1))


def graphs_in_a_list(model):
    attribute = onnx.helper.make_attribute("bodies", [straight("Identity", ["a"], ["b"])])
    model.graph.node[0].attribute.append(attribute)


def function_of_its_own(model):
    node = onnx.helper.make_node("Identity", ["x"], ["y"])
    one = onnx.helper.make_operatorsetid("", 17)
    model.functions.append(onnx.helper.make_function("", "Relu", ["x"], ["y"], [node], [one]))


WITHIN, ELSEWHERE = "has graphs within its graph", "takes its weights from other files"
CHANGES = {
    "loop without end": (loop_without_end, WITHIN),
    "branch": (branch, WITHIN),
    "scan": (scan, WITHIN),
    "graphs in a list": (graphs_in_a_list, WITHIN),
    "empty graph": (lambda m: m.graph.node[0].attribute.add().g.SetInParent(), WITHIN),
    "training steps": (lambda m: m.training_info.add().algorithm.CopyFrom(straight("Identity", ["a"], ["b"])), WITHIN),
    "function of its own": (function_of_its_own, "has functions of its own"),
    "sparse weights elsewhere": (lambda m: outside(m.graph.sparse_initializer.add().values, "weights"), ELSEWHERE),
    "sparse constant elsewhere": (
        lambda m: outside(m.graph.node[0].attribute.add().sparse_tensor.indices, "weights"),
        ELSEWHERE,
    ),
    "weights elsewhere": (lambda m: outside(m.graph.initializer[0], "/etc/hostname"), ELSEWHERE),
    "weights beside it": (weights_beside_it, ELSEWHERE),
    "weights said to be elsewhere": (weights_said_to_be_elsewhere, ELSEWHERE),
    "constant elsewhere": (
        lambda m: outside(next(n for n in m.graph.node if n.op_type == "Constant").attribute[0].t, "../secret"),
        ELSEWHERE,
    ),
    "operator of a library": (
        lambda m: setattr(m.graph.node[0], "domain", "com.example.run_my_code"),
        "has operators of the domain .com.example.run_my_code",
    ),
    "library of many lines": (  # found by random damage
        lambda m: setattr(m.graph.node[0], "domain", "\n\x0bhidden\x18"),
        r"has operators of the domain . hidden\\x18.",
    ),
    "weights that are no numbers": (weights_that_are_no_numbers, "answers with values that are not finite"),
    "state beyond all memory": (says("states", json.dumps([["state_0", [1, 2**40]]])), "unusable metadata .*state_0"),
    "transform beyond all memory": (says("n_fft", str(2**40)), "unusable metadata .*expected at most"),
    "hop beyond all memory": (says("hop", str(2**40)), "unusable metadata .*expected at most"),
    "text of many lines": (says("type", "a\n" * 10_000), "has type a a a"),
}


@pytest.mark.parametrize(("change", "words"), CHANGES.values(), ids=CHANGES)
def test_a_model_that_leads_out_of_its_file_or_gives_no_numbers_is_refused(tmp_path, monkeypatch, capfd, change, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights").write_bytes(bytes(1 << 16))
    model = onnx.load(EDGE)
    change(model)
    (tmp_path / "m.onnx").write_bytes(model.SerializeToString())
    refused(tmp_path / "m.onnx", words, capfd)


def varint(value, size=1):
    """Of at least so many bytes."""
    out = []
    while value or len(out) < size:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out[:-1], out[-1] & 0x7F])


FUNCTION = onnx.helper.make_function("", "F", [], [], [], []).SerializeToString()
"""Not empty: it has a name."""


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (varint(25 << 3 | 2) + varint(len(FUNCTION)) + FUNCTION, "functions of its own"),
        (varint(25 << 3 | 2, 5) + varint(len(FUNCTION), 5) + FUNCTION, "functions of its own"),
        (varint(1 << 32 | 25 << 3 | 2) + varint(len(FUNCTION)) + FUNCTION, "cannot be loaded .field 536870937"),
        (varint(7 << 3 | 2) + varint(4) + b"\x0a\x02\x3a\x00", "takes no part"),
        (varint(7 << 3 | 2) + varint(5) + b"\x0a\x03\x3a\x01x", "operators of the domain 'x'"),
        (varint(99 << 3 | 3) + varint(99 << 3 | 4), "cannot be loaded .field 99 .wire type 3."),
        (varint(99 << 3 | 2) + varint(1 << 40), "cannot be loaded .field 99 .wire type 2. says 1099511627776 bytes"),
        (varint(99 << 3) + b"\xff" * 10, "a number that does not end"),
        (b"\x80", "a number that does not end"),
        (varint(99 << 3) + b"\x00" + (varint(99 << 3) + b"\x00") * onnx_graph.MOST_FIELDS, "more than 1000000 fields"),
    ],
    ids=("function", "function, long numbers", "number cut to 32 bits", "node that asks for nothing", "second graph", "group")
    + ("beyond the end", "long number", "half a number", "many fields"),
)  # fmt: skip
def test_what_is_hidden_in_a_models_bytes_is_found(tmp_path, capfd, more, words):
    """Bytes behind those of a sound model: a library merges the fields of both."""
    (tmp_path / "m.onnx").write_bytes(EDGE.read_bytes() + more)
    if words == "takes no part":
        assert onnx_graph.refusal((tmp_path / "m.onnx").read_bytes()) is None
    else:
        refused(tmp_path / "m.onnx", words, capfd)


def test_text_in_the_graph_that_is_no_text_is_refused_without_a_word_on_standard_output(tmp_path, capfd):
    """Found by random damage: onnxruntime printed that it tries again."""
    content = EDGE.read_bytes().replace(b"speech_probability", b"speech_probabilit\xff")
    (tmp_path / "m.onnx").write_bytes(content)
    refused(tmp_path / "m.onnx", "cannot be loaded", capfd)


def test_a_model_beyond_all_sizes_is_not_read(tmp_path, capfd):
    with open(tmp_path / "m.onnx", "wb") as file:
        file.truncate(2 * onnx_session.MOST_BYTES)
    refused(tmp_path / "m.onnx", "expected at most", capfd)


@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(data=st.binary(max_size=200))
def test_any_bytes_are_refused_in_one_line(data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "any.onnx"
    path.write_bytes(data)
    with pytest.raises(ModelError, match="model .*any.onnx") as caught:
        Crnn(path)
    assert "\n" not in str(caught.value)


@settings(max_examples=10, deadline=None, derandomize=True, database=None)
@given(key=st.sampled_from(("n_fft", "hop", "states", "window", "training", "version")), value=st.text(max_size=30))
@pytest.mark.slow
def test_whatever_a_model_says_of_itself_it_is_taken_or_refused_in_one_line(key, value, tmp_path_factory):
    model = onnx.load(EDGE)
    says(key, value)(model)
    path = tmp_path_factory.getbasetemp() / "said.onnx"
    path.write_bytes(model.SerializeToString())
    try:
        Crnn(path)
    except ModelError as error:
        assert "\n" not in str(error)


def frame(engine, scale=1.0):
    rng = np.random.default_rng(3)
    spectra = scale * rng.standard_normal((4, engine.stft.bins, 2), np.float32).view(np.complex64)[..., 0]
    power = np.ones(engine.stft.bins, np.float32)
    return Frame(*spectra, noise_psd=power, residual_psd=power, idle=True)


def answering(path, spectrum, nan_below=0.0):
    """The engine with a network that answers this spectrum, and no number where the frame has less power than that."""
    model = onnx.load(EDGE)
    for node in model.graph.node:
        node.output[:] = ["raw" if name == "spectrum" else name for name in node.output]
    model.graph.initializer.extend(
        onnx.numpy_helper.from_array(np.array(value, np.float32), name)
        for name, value in (("nothing", 0.0), ("told", (spectrum, 0.0)), ("least", nan_below))
    )
    for kind, inputs, output in (
        ("Mul", ("raw", "nothing"), "silence"),
        ("Add", ("silence", "told"), "answer"),
        ("ReduceSumSquare", ("mic",), "power"),
        ("Sub", ("power", "least"), "over"),
        ("Sqrt", ("over",), "root"),  # of what is below zero, no number
        ("Mul", ("root", "nothing"), "zero"),
        ("Add", ("answer", "zero"), "spectrum"),
    ):
        model.graph.node.append(
            onnx.helper.make_node(kind, inputs, [output], **({"keepdims": 0} if output == "power" else {}))
        )
    onnx.save(model, path)
    return Crnn(path)


def test_a_network_that_falls_into_nan_is_passed_over_and_begins_anew(tmp_path):
    engine = answering(tmp_path / "m.onnx", 0.0, nan_below=100.0)  # a frame of ordinary level has a power of 500
    _, state = engine.step(frame(engine), engine.initial_state())
    assert all(tensor.any() for tensor in state[0])
    heard = frame(engine, 0.1)
    output, state = engine.step(heard, state)
    assert np.array_equal(output.spectrum, heard.error) and output.speech_probability == 0.0
    assert not any(tensor.any() for tensor in state[0])


def test_what_stands_far_above_all_that_is_expected_comes_through_whatever_the_network_says(tmp_path):
    engine = answering(tmp_path / "m.onnx", 0.0)
    heard, ones = frame(engine), np.ones(engine.stft.bins, np.float32)
    power, far = np.abs(heard.error) ** 2, np.arange(ones.size) % 2 == 0
    expected = (power / np.where(far, 400.0, 50.0)).astype(np.float32)
    heard = heard._replace(noise_psd=expected, residual_psd=0 * ones)
    output, _ = engine.step(heard._replace(idle=False), engine.initial_state())
    assert not output.spectrum.any()  # the robot speaks: it may all be the robot's
    output, _ = engine.step(heard, engine.initial_state())
    assert not output.spectrum[~far].any()
    np.testing.assert_allclose(output.spectrum[far], np.sqrt(1 - SURE / 400) * heard.error[far], rtol=1e-4)


def test_a_network_that_answers_too_loudly_is_turned_down(tmp_path):
    engine = answering(tmp_path / "m.onnx", 1e6)
    heard = frame(engine)
    output, _ = engine.step(heard, engine.initial_state())
    power, most = (float(np.vdot(x, x).real) for x in (output.spectrum, heard.mic))
    assert power == pytest.approx(LOUDEST * most, rel=1e-3)


def test_what_is_sure_is_no_louder_than_the_microphone_either(tmp_path):
    engine = answering(tmp_path / "m.onnx", 0.0)
    heard = frame(engine)
    nothing = 0 * heard.noise_psd
    heard = heard._replace(mic=0.1 * heard.error, noise_psd=nothing, residual_psd=nothing)
    output, _ = engine.step(heard, engine.initial_state())
    power = [np.vdot(spectrum, spectrum).real for spectrum in (output.spectrum, heard.mic)]
    assert power[0] == pytest.approx(LOUDEST * power[1], rel=1e-3)


def test_the_shipped_models_are_the_pinned_ones_and_the_page_says_so():
    page = (ROOT / "models" / "MODELS.md").read_text(encoding="utf-8")
    files = [path for folder in ("models", "bench/models") for path in (ROOT / folder).glob("*.[op]*")]
    there = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    assert onnx_session.SHIPPED == {name: there[name] for name in ("crnn.onnx", "crnn_int8.onnx")}
    for name, found in there.items():
        assert re.search(rf"`{name}` +`{found}`", page), name


def test_a_package_whose_model_was_damaged_says_so_instead_of_filtering_with_it(tmp_path, monkeypatch, capfd):
    own = ROOT / "models" / "crnn_int8.onnx"
    content = bytearray(own.read_bytes())
    content[len(content) // 2] ^= 1  # one bit of a weight: nothing else would notice
    (tmp_path / own.name).write_bytes(content)
    monkeypatch.setattr(onnx_session, "FOLDERS", (tmp_path,))
    refused(None, "not the one that belongs to this edgefilter.*reinstall", capfd)
