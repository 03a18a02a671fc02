"""The comparisons of trained networks, on a network of four steps."""

import json

import numpy as np
import pytest
import soundfile as sf

from bench.measure import networks, words_validation
from edgefilter.engines import create
from edgefilter.filter.stream import Stream
from export import train


class Deaf:
    """A recogniser that hears one word right."""

    def __init__(self, *_):
        pass

    def transcribe(self, samples):
        return "one" if samples.any() else ""


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
    (folder / "meta.json").write_text(json.dumps({"room": "lab", "text": "one two", "start": 16000, "end": 32000}))
    return folder.parent


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A folder of export/train.py."""
    small = ["--channels", "2", "2", "2", "2", "--hidden", "4", "--smoke"]
    folders = ["--data", str(tmp_path / "d"), "--validation", str(tmp_path / "v"), "--output", str(tmp_path / "tiny")]
    monkeypatch.setattr("sys.argv", ["train", *folders, *small])
    assert train.main() == 0
    return tmp_path / "tiny"


def test_networks_are_compared(tmp_path, run, conversation, monkeypatch):
    monkeypatch.setattr(networks, "Recogniser", Deaf)
    monkeypatch.setattr(networks, "HOPS", 3)
    monkeypatch.setattr(networks.Conversation, "profile", None)
    out = tmp_path / "results" / "networks"
    arguments = [
        "--runs",
        str(run),
        "--conversations",
        str(conversation),
        "--whisper",
        str(tmp_path),
        "--output",
        str(out),
    ]
    monkeypatch.setattr("sys.argv", ["networks", *arguments])
    assert networks.main() == 0
    found = json.loads(out.with_suffix(".json").read_text())
    assert [row["engine"] for row in found["utterances"]] == ["linear", "ss", "tiny"]
    assert all(row["errors"] == 1 and row["words"] == 2 and np.isfinite(row["si_sdr"]) for row in found["utterances"])
    assert found["runs"][0]["steps"] == 4 and found["runs"][0]["hot_ms"]["p50"] > 0
    assert "| tiny | 512/256" in out.with_suffix(".md").read_text() and out.with_suffix(".png").stat().st_size > 1000


def test_checkpoints_are_judged_by_words_warm_and_cold_against_ss(tmp_path, run, conversation, monkeypatch):
    monkeypatch.setattr(words_validation, "Recogniser", Deaf)
    monkeypatch.setattr(words_validation.Conversation, "profile", None)
    arguments = ["--checkpoints", run / "last.pt", "--conversations", conversation, "--cold", "--whisper", tmp_path]
    arguments += ["--output", tmp_path / "results" / "words", "--cache", tmp_path / "cache"]
    monkeypatch.setattr("sys.argv", ["words_validation", *map(str, arguments)])
    assert words_validation.main() == 0
    found = json.loads((tmp_path / "results" / "words.json").read_text())["utterances"]
    tiny = "tiny/last, step 4"
    mixed = [name + share for name in ("ss", "crnn", tiny, f"{tiny}, 0.5 ss") for share in ("", ", 0.2 error")]
    assert [row["system"] for row in found] == 2 * ["linear", *mixed]
    assert [row["kind"] for row in found] == 9 * ["conversations lab"] + 9 * ["conversations lab cold"]
    assert all((row["errors"], row["deletions"], row["insertions"], row["words"]) == (1, 1, 0, 2) for row in found)
    by_name = {row["system"]: row["si_sdr"] for row in found[:9]}
    assert by_name["ss"] == pytest.approx(by_name[tiny], abs=0.1)  # after four steps it is still nearly 'ss'
    assert len(set(by_name.values())) == 9
    assert "| tiny/last, step 4 | 50 | 50 | 0 | +0.0 [+0.0, +0.0] |" in (tmp_path / "results/words.md").read_text()


def test_what_an_earlier_result_holds_is_not_run_again_unless_it_is_of_other_data(
    tmp_path, run, conversation, monkeypatch, capsys
):
    monkeypatch.setattr(words_validation, "Recogniser", Deaf)
    monkeypatch.setattr(words_validation.Conversation, "profile", None)
    shared = ["--conversations", conversation, "--whisper", tmp_path / "w", "--wiener", "--error"]
    (tmp_path / "w").mkdir()
    (tmp_path / "w" / "model.bin").write_bytes(b"whisper")

    def words(name, *more):
        given = [*shared, "--cache", tmp_path / "cache", "--output", tmp_path / name, *more]
        monkeypatch.setattr("sys.argv", ["words_validation", *map(str, given)])
        return words_validation.main()

    def rows(name):
        return json.loads((tmp_path / f"{name}.json").read_text())["utterances"]

    assert words("first") == 0
    ran = []
    monkeypatch.setattr(words_validation, "answer", lambda *_: ran.append(1) or np.zeros(48000, np.float32))
    assert words("second", "--checkpoints", run / "last.pt", "--known", tmp_path / "first.json") == 0
    assert len(ran) == 1 and rows("second")[:3] == rows("first") and len(rows("second")) == 4
    (conversation / "more.txt").write_text("other data", encoding="utf-8")
    assert words("third", "--known", tmp_path / "first.json") == 1
    assert "first.json was made with another conversations: measure it again" in capsys.readouterr().err
    (tmp_path / "first.json").write_text('{"stamp": 1}', encoding="utf-8")
    assert words("third", "--known", tmp_path / "first.json") == 1
    assert "first.json is no result of words_validation" in capsys.readouterr().err


def test_an_engine_answers_kept_frames_as_a_stream_does():
    mic, ref = 0.1 * np.random.default_rng(0).standard_normal((2, 20000)).astype(np.float32)
    case = words_validation.Case("kind", "name", mic, ref, mic, slice(None), "one")
    engine = create("ss")
    kept = words_validation.answer(engine, words_validation.frames(case, engine.stft, learning=False), mic.size)
    stream = Stream(engine)
    assert np.array_equal(kept, np.concatenate((stream.process(mic, ref), stream.flush())))


def test_a_folder_without_a_network_is_one_line(tmp_path, conversation, monkeypatch, capsys):
    monkeypatch.setattr(networks, "Recogniser", Deaf)
    arguments = [
        "--runs",
        str(tmp_path),
        "--conversations",
        str(conversation),
        "--whisper",
        str(tmp_path),
        "--output",
        str(tmp_path / "o"),
    ]
    monkeypatch.setattr("sys.argv", ["networks", *arguments])
    assert networks.main() == 1
    assert "no best.pt" in capsys.readouterr().err
