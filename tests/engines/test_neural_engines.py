"""The neural engines load real files, run them as they should be run, and refuse every other file in one line."""

import hashlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import soundfile

from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines import create, onnx_session
from edgefilter.engines.crnn import LOUD, Crnn, Level
from edgefilter.engines.paper_crnn import PaperCrnn
from edgefilter.errors import ModelError, SignalError, UsageError
from edgefilter.filter.ego_filter import EgoFilter, enhance
from edgefilter.filter.stream import Stream
from edgefilter.profile.data import LEARNED, Profile
from edgefilter.types import Frame
from tests import conformance
from tests.program import DEMO, ROOT, demo, here, one_line

DATA = Path(__file__).parents[1] / "data"
EDGE, PAPER = DATA / "crnn.onnx", DATA / "paper_crnn.onnx"


def changed(folder: Path, metadata: dict[str, str | None], source: Path = EDGE) -> Path:
    """A copy of the model whose metadata says something else, or nothing where None."""
    model = onnx.load(source)
    kept = {entry.key: entry.value for entry in model.metadata_props} | metadata
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {key: value for key, value in kept.items() if value is not None})
    path = folder / "changed.onnx"
    onnx.save(model, path)
    return path


def spectrum(rng: np.random.Generator, bins: int) -> np.ndarray:
    return (rng.standard_normal(bins) + 1j * rng.standard_normal(bins)).astype(np.complex64)


def test_crnn_answers_what_onnxruntime_answers_for_the_same_frames():
    engine = Crnn(EDGE)
    session = onnx_session.open_session(EDGE)
    rng = np.random.default_rng(0)
    state, theirs = engine.initial_state(), [np.zeros(shape, np.float32) for _, shape in engine.model.states]
    for _ in range(5):
        error, mic, reference, echo = (spectrum(rng, engine.stft.bins) for _ in range(4))
        noise, residual = rng.random((2, engine.stft.bins)).astype(np.float32)
        heard = Frame(mic=mic, reference=reference, echo=echo, error=error, noise_psd=noise, residual_psd=residual)
        busy, (output, state) = engine.step(heard, state)[0], engine.step(heard._replace(idle=True), state)
        assert busy.recognise is None and np.array_equal(busy.sounds[0], output.spectrum)
        scale, of_reference = (level.factor(usual) for usual, level in zip(LOUD, state[2], strict=True))
        spectra = scale * error, scale * mic, of_reference * reference, scale * echo
        pairs = [np.stack((x.real, x.imag), axis=-1)[None] for x in spectra]
        powers = [scale**2 * noise[None], scale**2 * residual[None]]
        names = [slot.name for slot in session.get_inputs()]
        listen, recognise, probability, *theirs = session.run(
            None, dict(zip(names, pairs + powers + theirs, strict=True))
        )
        for sound, found in ((output.spectrum, listen), (output.recognise, recognise)):
            np.testing.assert_array_equal(sound, np.float32(1 / scale) * (found[0, :, 0] + 1j * found[0, :, 1]))
        assert output.speech_probability == probability[0] and 0 < probability[0] < 1
    assert any(tensor.any() for tensor in state[0])


@pytest.mark.parametrize(("added", "told"), [(2.0, 1.0), (-2.0, 0.0)])
def test_a_model_that_answers_a_probability_beyond_0_to_1_is_held_to_them(tmp_path, added, told):
    model = onnx.load(EDGE)
    for node in model.graph.node:
        node.output[:] = ["raw" if name == "speech_probability" else name for name in node.output]
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array([added], np.float32), "added"))
    model.graph.node.append(onnx.helper.make_node("Add", ["raw", "added"], ["speech_probability"]))
    onnx.save(model, tmp_path / "beyond.onnx")
    engine, rng = Crnn(tmp_path / "beyond.onnx"), np.random.default_rng(2)
    heard = Frame(*(spectrum(rng, 257) for _ in range(4)), *rng.random((2, 257)).astype(np.float32))
    assert engine.step(heard, engine.initial_state())[0].speech_probability == told


@pytest.mark.parametrize(("below_db", "heard"), [(36.0, True), (44.0, False)])
def test_what_is_far_softer_than_the_robot_has_been_is_nobody_who_interrupts(below_db, heard):
    engine, rng = Crnn(EDGE), np.random.default_rng(3)
    frame = Frame(*(spectrum(rng, 257) for _ in range(4)), *np.full((2, 257), 1e-6, np.float32))
    tensors, mask, (mic, reference) = engine.initial_state()
    answer = engine.step(frame, (tensors, mask, (mic, reference)))[0].spectrum
    for _ in range(3):  # the level of the robot changes what the network is told, and so its answer
        loud = mic._replace(loudest=float(np.sum(np.abs(answer) ** 2)) * 10 ** (below_db / 10))
        output, _ = engine.step(frame, (tensors, mask, (loud, reference._replace(loudest=1.0))))
        answer = output.spectrum
    assert (output.speech_probability > 0.0) == heard


def test_of_a_calibrated_robot_ss_has_its_share_of_the_answer():
    profile = Profile.load(DEMO / "profile.npz")
    engines = create("crnn", profile, model=EDGE), create("crnn", model=EDGE), create("ss")
    states = [engine.initial_state() for engine in engines]
    rng = np.random.default_rng(1)
    for _ in range(5):
        spectra = [spectrum(rng, 257) for _ in range(4)]
        powers = rng.uniform(0.5, 2.0, (2, 257)).astype(np.float32)
        powers[0] = 0.0  # the network is told of noise as it is where it is calibrated alone
        answers, states = zip(*(e.step(Frame(*spectra, *powers), s) for e, s in zip(engines, states, strict=True)))
        both, network, mask = (answer.spectrum for answer in answers)
        np.testing.assert_allclose(both, 0.6 * network + 0.4 * mask, atol=1e-6)  # models/MODELS.md, the shares of ss
        assert answers[0].speech_probability == answers[1].speech_probability


def test_of_a_robot_whose_path_was_learned_the_network_answers_alone():
    learned = replace(Profile.load(DEMO / "profile.npz"), source=LEARNED)
    engines = create("crnn", learned, model=EDGE), create("crnn", model=EDGE)
    rng = np.random.default_rng(1)
    heard = Frame(*(spectrum(rng, 257) for _ in range(4)), np.zeros(257, np.float32), np.ones(257, np.float32))
    answers = [engine.step(heard, engine.initial_state())[0].spectrum for engine in engines]
    np.testing.assert_array_equal(*answers)


def test_streams_in_several_threads_share_an_engine_without_mixing():
    engine = Crnn(EDGE)
    sounds = [conformance.conversation(12000, seed=seed) for seed in range(4)]

    def run(sound: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        stream = Stream(engine)
        return np.concatenate(
            [stream.process(sound[0][at : at + 256], sound[1][at : at + 256]) for at in range(0, 12000, 256)]
        )

    alone = [run(sound) for sound in sounds]
    with ThreadPoolExecutor(4) as pool:
        for wanted, found in zip(alone, pool.map(run, sounds)):
            np.testing.assert_array_equal(found, wanted)


def test_the_stream_tells_the_probability_of_speech():
    mic, ref = conformance.conversation(4000)
    ego = EgoFilter(engine="crnn", model=EDGE)
    assert ego.speech_probability is None
    ego.process(mic, np.zeros_like(ref))  # nobody but the human can be heard
    assert 0 < ego.speech_probability < 1


def test_stats_name_the_model_and_what_it_says_of_itself():
    stats = EgoFilter(engine="crnn", model=EDGE).stats()
    assert stats["model"] == {"file": str(EDGE), "training": {"data": "none: random weights", "seed": 0}, "figures": {}}
    assert EgoFilter(engine="ss").stats()["model"] is None


def test_one_thread_without_spinning():
    options = onnx_session.open_session(EDGE).get_session_options()
    assert options.intra_op_num_threads == options.inter_op_num_threads == 1
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"


def test_denormal_numbers_survive_in_the_thread_of_the_caller_and_in_those_it_starts():
    """In a process of its own, for only its first session changes that; the library's users compute beside the filter."""
    code = (
        "import threading, numpy as np\n"
        "from edgefilter import EgoFilter\n"
        "tell = lambda: print((np.full(9, 1e-40, np.float32) * np.float32(0.5)).all())\n"
        f"ego = EgoFilter(engine='crnn', model={str(EDGE)!r})\n"
        "tell()\n"
        "ego.process(np.zeros(4096), np.zeros(4096))\n"
        "tell()\n"
        "threading.Thread(target=tell).start()"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["True"] * 3


@pytest.mark.parametrize(
    "metadata, words",
    [
        ({"type": "edgefilter-paper-crnn"}, "type edgefilter-paper-crnn, expected edgefilter-crnn"),
        ({"type": None}, "type unknown, expected edgefilter-crnn"),
        ({"version": "1"}, "version 1, expected 2"),
        ({"version": "3"}, "version 3, expected 2"),
        ({"sample_rate": "48000"}, "sample_rate 48000, expected 16000"),
        ({"hop": None}, "does not say its hop"),
        ({"training": None}, "does not say its training"),
        ({"hop": "many"}, "unusable metadata.*many"),
        ({"hop": "512"}, "unusable metadata.*inverted"),
        ({"n_fft": "1024"}, r"inputs .*error \[1, 257, 2\].*wants.*error \[1, 513, 2\]"),
        ({"states": "[]"}, "inputs .*state_0"),
        ({"states": '[["state_0", [1, 6, 9]]]'}, r"wants.*state_0 \[1, 6, 9\]"),
        ({"states": "nonsense"}, "unusable metadata"),
    ],
)
def test_a_model_that_does_not_fit_is_refused_in_one_line(tmp_path, metadata, words):
    with pytest.raises(ModelError, match=words) as caught:
        Crnn(changed(tmp_path, metadata))
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_model_is_refused(tmp_path):
    (tmp_path / "text.onnx").write_text("this is not a model")
    (tmp_path / "cut.onnx").write_bytes(EDGE.read_bytes()[:3000])
    for name in ("text.onnx", "cut.onnx"):
        with pytest.raises(ModelError, match="cannot be loaded"):
            Crnn(tmp_path / name)


def test_the_model_comes_from_the_option_then_the_variable_then_the_package(tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_session, "FOLDERS", (tmp_path / "models", tmp_path))
    with pytest.raises(ModelError, match="no crnn_int8.onnx.*--model or EDGEFILTER_CRNN"):
        Crnn()
    (tmp_path / "crnn_int8.onnx").write_bytes(EDGE.read_bytes())
    with pytest.raises(ModelError, match="crnn_int8.onnx is not the one that belongs to this edgefilter"):
        Crnn()
    monkeypatch.setitem(onnx_session.SHIPPED, "crnn_int8.onnx", hashlib.sha256(EDGE.read_bytes()).hexdigest())
    assert Crnn().model.path == tmp_path / "crnn_int8.onnx"
    monkeypatch.setenv("EDGEFILTER_CRNN", str(EDGE))
    assert Crnn().model.path == EDGE
    assert Crnn(tmp_path / "crnn_int8.onnx").model.path == tmp_path / "crnn_int8.onnx"
    monkeypatch.setenv("EDGEFILTER_CRNN", str(tmp_path / "gone.onnx"))
    with pytest.raises(ModelError, match="gone.onnx, which EDGEFILTER_CRNN names, is no file"):
        Crnn()


def test_the_packages_int8_file_is_of_the_same_training_as_the_exact_one():
    exact, used = Crnn(Path(__file__).parents[2] / "models/crnn.onnx").model, Crnn().model
    assert used.path.name == "crnn_int8.onnx"
    for name in ("training", "figures", "states", "stft"):
        assert getattr(used, name) == getattr(exact, name), name


@pytest.mark.slow
def test_the_exact_network_filters_the_demo_as_the_int8_one_does():
    """Both files are run: each brings the human out, and what int8 weights change is far under the answer."""
    mic, ref, human = demo("mic", "reference", "human")
    models = (ROOT / "models/crnn.onnx", ROOT / "models/crnn_int8.onnx")
    exact, small = (enhance(mic, ref, DEMO / "profile.npz", engine="crnn", model=model) for model in models)
    speaking = np.flatnonzero(human)
    span = slice(speaking[0], speaking[-1] + 1)
    for out in (exact, small):
        assert si_sdr(out[span], human[span]) > 9.2  # 9.3 is promised; random weights give 3.7
    apart = 10 * np.log10(np.mean(exact**2) / np.mean((exact - small) ** 2))
    assert 40 < apart < 90  # 62 were seen; 41 to 56 are in models/MODELS.md. More would be one file twice


def test_a_model_for_an_engine_without_one_is_a_mistake():
    with pytest.raises(UsageError, match="engine ss has no network"):
        create("ss", model=EDGE)


def test_paper_crnn_without_a_model_says_how_to_make_one(monkeypatch):
    monkeypatch.delenv("EDGEFILTER_PAPER_CRNN", raising=False)
    with pytest.raises(ModelError, match="export.train --network paper.*export.onnx_export"):
        PaperCrnn()


def test_each_engine_refuses_the_others_model():
    with pytest.raises(ModelError, match="type edgefilter-crnn, expected edgefilter-paper-crnn"):
        PaperCrnn(EDGE)
    with pytest.raises(ModelError, match="type edgefilter-paper-crnn, expected edgefilter-crnn"):
        Crnn(PAPER)


def test_paper_crnn_refuses_another_stft(tmp_path):
    with pytest.raises(ModelError, match="hop=200.*expected.*hop=160"):
        PaperCrnn(changed(tmp_path, {"hop": "200"}, PAPER))


def test_paper_crnn_masks_the_mixtures_magnitude_and_keeps_its_phase():
    engine = PaperCrnn(PAPER)
    rng = np.random.default_rng(1)
    bins = engine.stft.bins
    mic, ref = (np.stack([spectrum(rng, bins) for _ in range(7)]) for _ in range(2))
    nothing = np.zeros(bins, np.float32)
    answer = np.stack(engine.answer([Frame(m, r, m, m, nothing, nothing) for m, r in zip(mic, ref)]))
    heard = {"mic_magnitude": np.abs(mic)[None], "reference_magnitude": np.abs(ref)[None]}
    mask = onnx_session.open_session(PAPER).run(None, heard)[0][0]
    assert mask.std() > 1e-4
    np.testing.assert_array_equal(answer, mask * mic)


def test_paper_crnn_refuses_a_recording_that_is_too_long_before_it_fills_the_memory():
    engine = PaperCrnn(PAPER)
    engine.longest = 100
    stream = Stream(engine)
    mic, ref = conformance.conversation(17_000)
    with pytest.raises(SignalError, match="longer than 1 s.*paper-crnn"):
        stream.process(mic, ref)
    mic, ref = conformance.conversation(15_000)
    assert enhance(mic, ref, engine="paper-crnn", model=PAPER).shape == mic.shape


@pytest.mark.slow
def test_the_command_line_takes_a_model_and_reports_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mic, ref = conformance.conversation()
    soundfile.write("mic.wav", mic, 16000, "FLOAT")
    soundfile.write("ref.wav", ref, 16000, "FLOAT")

    def run(engine: str, model: Path) -> subprocess.CompletedProcess:
        return here(
            *"run --input mic.wav --reference ref.wav --output out.wav --engine".split(), engine, "--model", model
        )

    done = run("crnn", EDGE)
    assert done.returncode == 0 and "algorithmic latency 32 ms" in done.stderr, done.stderr
    expected = enhance(mic, ref, engine="crnn", model=EDGE)
    np.testing.assert_allclose(soundfile.read("out.wav")[0], expected, atol=2**-15)
    done = run("paper-crnn", PAPER)
    assert done.returncode == 0 and "answers at the end of the recording" in done.stderr, done.stderr
    one_line(run("crnn", PAPER), 1, "expected edgefilter-crnn")


def test_a_model_needs_its_engine_named():
    with pytest.raises(UsageError, match="without an engine for it: name one of crnn, paper-crnn"):
        EgoFilter(model=EDGE)


def test_a_budget_does_not_replace_an_engine_that_waits_for_the_end():
    mic, ref = conformance.conversation(8000)
    ego = EgoFilter(engine="paper-crnn", model=PAPER, budget_ms=0.001)
    assert ego.waits_for_end and ego.process(mic, ref).size == 0 and ego.flush().shape == mic.shape
    assert ego.stats()["latency_ms"] is None
    assert "a budget of 0.001 ms does not change the engine: it waits for the end" in ego.engine_reason


def test_the_loudest_frame_is_one_of_three_as_loud_and_is_forgotten_by_10_db_in_a_minute():
    level = Level().after(1.0).after(0.25)
    assert level.loudest == 0.0 and level.factor(4.0) == 1.0, "a click is no level"
    level = level.after(2.0)
    assert level.loudest == 0.25 and level.factor(4.0) == 4.0
    for _ in range(round(60.0 / 0.016)):
        level = level.after(0.0)
    assert level.loudest == pytest.approx(0.025, rel=1e-3)
