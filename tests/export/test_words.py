"""The comparisons of trained networks, on a network of four steps."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile as sf

from bench import __main__ as program
from bench import results
from bench.recordings import Clip, Conversation, Signals
from bench.training import words
from edgefilter.engines import create
from edgefilter.filter.stream import Stream
from export import onnx_export, train
from tests.bench.conftest import rows_of


@pytest.fixture
def whisper(tmp_path, monkeypatch):
    """A recogniser that gets one word right."""
    model = SimpleNamespace(transcribe=lambda samples, **options: ([SimpleNamespace(text=" one")], None))
    monkeypatch.setitem(sys.modules, "faster_whisper", SimpleNamespace(WhisperModel=lambda *_, **options: model))
    monkeypatch.setattr(Conversation, "profile", None)
    (tmp_path / "whisper").mkdir()
    (tmp_path / "whisper" / "model.bin").write_bytes(b"whisper")
    (tmp_path / "whisper" / "config.json").write_text("{}")
    return tmp_path / "whisper"


@pytest.fixture
def conversation(tmp_path):
    folder = tmp_path / "conversations" / "lab_00"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    robot, human = 0.1 * rng.standard_normal((2, 2 * 16000))
    human[:16000] = 0
    click = np.zeros(16000)
    click[800] = 0.5
    for name, samples in {
        "mic": robot + 0.1 * human,
        "ref": robot,
        "clean": 0.1 * human,
        "sweep_ref": click,
        "sweep_mic": click,
    }.items():
        sf.write(folder / f"{name}.flac", samples, 16000)
    sf.write(folder / "fan_only.flac", 1e-3 * rng.standard_normal(32000), 16000)
    (folder / "meta.json").write_text(
        json.dumps({"room": "lab", "text": "one two", "speaker": "s", "start": 16000, "end": 32000})
    )
    return folder.parent


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder of export/train.py, with last.onnx."""
    tmp_path = tmp_path_factory.mktemp("run")
    small = ["--channels", "2", "2", "2", "2", "--hidden", "4", "--smoke"]
    folders = ["--data", str(tmp_path / "d"), "--validation", str(tmp_path / "v"), "--output", str(tmp_path / "tiny")]
    assert train.main([*folders, *small]) == 0
    assert onnx_export.main([str(tmp_path / "tiny/last.pt"), "--output", str(tmp_path / "tiny/last.onnx")]) == 0
    return tmp_path / "tiny"


@pytest.mark.slow
def test_networks_are_compared_by_words_with_a_profile_and_without_against_ss(tmp_path, run, conversation, whisper):
    arguments = [
        "--networks",
        run / "last.onnx",
        "--conversations",
        conversation,
        "--cold",
        "--silent",
        "--whisper",
        whisper,
    ]
    arguments += ["--output", tmp_path / "results" / "training", "--cache", tmp_path / "cache"]
    assert program.main(["training", "words", *map(str, arguments)]) == 0
    part = results.read(tmp_path / "results" / "training.json")["parts"]["words"]
    found = rows_of(part["rows"])
    tiny = "tiny/last"
    mixed = [name + share for name in ("ss", "crnn", tiny, f"{tiny}, 0.5 ss") for share in ("", ", 0.2 error")]
    assert [row["system"] for row in found] == 3 * ["linear", *mixed]
    kinds = ("conversations lab", "conversations lab cold", "conversations lab robot silent")
    assert [row["kind"] for row in found] == [kind for kind in kinds for _ in range(9)]
    assert all((row["errors"], row["deletions"], row["insertions"], row["words"]) == (1, 1, 0, 2) for row in found)
    by_name = {row["system"]: row["si_sdr"] for row in found[:9]}
    assert by_name["ss"] == pytest.approx(by_name[tiny], abs=0.1)  # after four steps it is still nearly 'ss'
    assert by_name["crnn"] != by_name[tiny]
    assert all(by_name[name] != by_name[f"{name}, 0.2 error"] for name in ("crnn", tiny))  # the share is another answer
    assert found[18]["si_sdr"] > 15 > by_name["linear"]  # the fan alone, 20 dB below the human
    assert "| tiny/last | 50 | 50 | 0 | 0.0 |" in (tmp_path / "results" / "training.md").read_text()


@pytest.mark.slow
def test_what_is_known_is_not_run_again(tmp_path, run, conversation, whisper, monkeypatch):
    shared = ["training", "words", "--conversations", conversation, "--whisper", whisper, "--wiener", "--error"]

    def compare(name, *more):
        given = [*shared, "--cache", tmp_path / "cache", "--output", tmp_path / name, *more]
        assert program.main([str(one) for one in given]) == 0
        return rows_of(results.read(tmp_path / f"{name}.json")["parts"]["words"]["rows"])

    first, ran, answer = compare("first"), [], words.answer
    monkeypatch.setattr(words, "answer", lambda *given: ran.append(1) or answer(*given))
    second = compare("second", "--networks", run / "last.onnx")
    assert len(ran) == 1 and second[:3] == first and len(second) == 4


def test_an_engine_answers_kept_frames_as_a_stream_does():
    mic, ref = 0.1 * np.random.default_rng(0).standard_normal((2, 20000)).astype(np.float32)

    class Scene:
        name = "scene"

        def signals(self):
            return Signals(mic, ref, mic)

    case = words.Case("kind", Clip("set", "lab", Scene()), None)
    engine = create("ss")
    kept = words.answer(engine, words.frames(case, engine.stft, learning=False), mic.size)
    stream = Stream(engine)
    assert np.array_equal(kept, np.concatenate((stream.process(mic, ref), stream.flush())))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing to listen to: give --conversations"),
        (["--real", "HERE"], "--real lays humans on recordings: give --speech"),
        (["--conversations", "HERE"], "words need a recogniser: give --whisper"),
    ],
)
def test_what_is_missing_is_one_line(arguments, said, tmp_path, capsys):
    assert program.main(["training", "words", *(str(tmp_path) if one == "HERE" else one for one in arguments)]) == 1
    assert said in capsys.readouterr().err
