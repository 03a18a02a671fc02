"""HUMAN, ROBOT and WHISPER out of archives of the published formats, small ones made here."""

from __future__ import annotations

import csv
import hashlib
import io
import re
import stat
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf

from bench.simulate import corpora
from bench.simulate.conversations import read_clips
from edgefilter.types import SAMPLE_RATE as RATE

SELECTION = """set\tarchive\tspeaker\tchapter\tutterances
train\ttrain-clean-100\t103\t1240\t0
train\tspeechocean762\t0036\t\t34,36
val\ttest-other\t367\t13\t0-1
test\ttest-clean\t1089\t134\t5,9
"""
SENTENCES = """set\tvoice\tnumber\ttext
train\taf_one\t0\tthe first sentence
val\tbm_two\t0\tanother one
test\taf_three\t1\tthe last
"""


def sound(seed: int, seconds: float = 0.5) -> np.ndarray:
    return (0.1 * np.random.default_rng(seed).standard_normal(int(seconds * RATE))).astype(np.float32)


def encoded(samples: np.ndarray, kind: str, rate: int = RATE) -> bytes:
    buffer = io.BytesIO()
    sf.write(buffer, samples, rate, format=kind, subtype="PCM_16")
    return buffer.getvalue()


def pack(path: Path, files: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return path


def librispeech(folder: Path, name: str, speaker: str, chapter: str, count: int) -> Path:
    """An archive with count utterances of one chapter, its texts behind the recordings, and what else lies in one."""
    place = f"LibriSpeech/{name}/{speaker}/{chapter}"
    names = [f"{speaker}-{chapter}-{number:04d}" for number in range(count)]
    files = {f"{place}/{key}.flac": encoded(sound(number), "FLAC") for number, key in enumerate(names)}
    files[f"{place}/{speaker}-{chapter}.trans.txt"] = "".join(
        f"{key} THE TEXT OF {i}\n" for i, key in enumerate(names)
    ).encode()
    return pack(folder / f"{name}.tar.gz", {"LibriSpeech/SPEAKERS.TXT": b"; of no use here\n", **files})


def speechocean(folder: Path) -> Path:
    names = ("000360034", "000360036", "000360099")
    files = {f"speechocean762/WAVE/SPEAKER0036/{name}.WAV": encoded(sound(i), "WAV") for i, name in enumerate(names)}
    files["speechocean762/train/text"] = b"000360034\tWE SPEAK OUT\n"
    files["speechocean762/test/text"] = b"000360036 I COULD DO\n000360099 NOT TAKEN\n"
    return pack(folder / "speechocean762.tar.gz", files)


@pytest.fixture
def given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """All four archives, with selection and published checksums made to fit."""
    folder = tmp_path / "downloads"
    folder.mkdir()
    for name, text in (("SELECTION", SELECTION), ("SENTENCES", SENTENCES)):
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.setattr(corpora.read_selection, "__defaults__", (tmp_path / "SELECTION",))
    monkeypatch.setattr(corpora.read_sentences, "__defaults__", (tmp_path / "SENTENCES",))
    made = [
        librispeech(folder, "train-clean-100", "103", "1240", 2),
        librispeech(folder, "test-clean", "1089", "134", 10),
    ]
    made += [librispeech(folder, "test-other", "367", "13", 3), speechocean(folder)]
    for path in made[:3]:
        monkeypatch.setitem(corpora.MD5, corpora.archive_name(path), hashlib.md5(path.read_bytes()).hexdigest())
    return made


def run(*arguments: object) -> int:
    return corpora.main([*map(str, arguments)])


def test_human_has_the_selected_recordings_and_their_texts(given: list[Path], tmp_path: Path) -> None:
    data = tmp_path / "data"
    assert run("--output", data, "--archives", *given) == 0
    told = {name: (data / "human" / name / "transcripts.tsv").read_text(encoding="utf-8") for name in corpora.SETS}
    assert told["train"].splitlines() == [
        "ls103/103-1240-0000.flac\t103\t0.50\tthe text of 0",
        "so0036/000360034.flac\tso0036\t0.50\twe speak out",
        "so0036/000360036.flac\tso0036\t0.50\ti could do",
    ]
    assert told["val"].splitlines()[1] == "367/367-13-0001.flac\t367\t0.50\tthe text of 1"
    assert told["test"].splitlines()[1] == "1089/1089-134-0009.flac\t1089\t0.50\tthe text of 9"
    for place, seed in (("test/1089/1089-134-0009.flac", 9), ("train/so0036/000360036.flac", 1)):
        samples, rate = sf.read(data / "human" / place)
        assert rate == RATE
        np.testing.assert_allclose(samples, sound(seed), atol=2**-15)  # 16 bit
    assert len([path for path in data.rglob("*.flac")]) == 7  # and nothing that was not selected
    assert [clip.text for clip in read_clips(data / "human" / "test", (0.1, 1.0))] == ["the text of 5", "the text of 9"]


def test_a_set_whose_archives_are_not_all_given_is_left_out_and_named(
    given: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--output", tmp_path / "data", "--archives", *given[:2]) == 0
    assert [path.name for path in (tmp_path / "data" / "human").iterdir()] == ["test"]
    error = capsys.readouterr().err
    assert "human/train needs speechocean762 as well" in error and "human/val needs test-other as well" in error


def test_checksums_are_written_compared_and_added_to(
    given: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    assert run("--output", first, "--archives", *given[:2]) == 0
    assert run("--output", first, "--archives", given[2]) == 0
    sums = (first / "checksums.tsv").read_text(encoding="utf-8")
    found = {row["what"]: row for row in csv.DictReader(io.StringIO(sums), delimiter="\t")}
    assert set(found) == {"human/test", "human/val", "test-clean.tar.gz", "test-other.tar.gz", "train-clean-100.tar.gz"}
    assert found["test-clean.tar.gz"]["sha256"] == hashlib.sha256(given[1].read_bytes()).hexdigest()
    assert run("--output", second, "--archives", given[1], "--checksums", first / "checksums.tsv") == 0
    capsys.readouterr()
    (first / "checksums.tsv").write_text(sums.replace(found["human/test"]["sha256"], "0" * 64), encoding="utf-8")
    assert run("--output", second, "--archives", given[1], "--checksums", first / "checksums.tsv") == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error == f"human/test has the sha256 {found['human/test']['sha256']}, checksums.tsv says {'0' * 64}"


def test_published_checksums_are_those_of_librispeech() -> None:
    assert set(corpora.MD5) == {u.archive for u in corpora.read_selection()} - {corpora.SPEECHOCEAN}
    assert all(len(md5) == 32 for md5 in corpora.MD5.values())


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        ("other bytes", "has the MD5 .*, expected .*: download it again"),
        ("cut off", "cannot be read as a tar archive"),
        ("lacking", "lacks 1 of 2 recordings, 1089-134-0009 first"),
        ("without text", "lacks 1 of 2 texts, 1089-134-0009 first"),
        ("8 kHz", "has 8000 Hz and 1 channels, expected 16000 Hz mono"),
        ("other name", "nothing is taken from clean"),
        ("gone", "No such file or directory; expected a downloaded archive"),
    ],
)
def test_an_archive_that_is_not_what_it_should_be_is_one_line(
    damage: str,
    says: str,
    given: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = given[1]
    place = "LibriSpeech/test-clean/1089/134"
    texts = {f"{place}/1089-134.trans.txt": b"1089-134-0005 ONE\n1089-134-0009 TWO\n"}
    sounds = {f"{place}/1089-134-000{n}.flac": encoded(sound(n), "FLAC") for n in (5, 9)}
    if damage == "other bytes":
        path.write_bytes(path.read_bytes() + b"\0")
    elif damage == "cut off":
        path.write_bytes(path.read_bytes()[:3000])
    elif damage == "lacking":
        pack(path, dict(list(sounds.items())[:1]) | texts)
    elif damage == "without text":
        pack(path, sounds | {name: content.splitlines()[0] for name, content in texts.items()})
    elif damage == "8 kHz":
        pack(path, {name: encoded(sound(0), "FLAC", 8000) for name in sounds} | texts)
    elif damage == "other name":
        path = path.rename(path.with_name("clean.tar.gz"))
    else:
        path.unlink()
    if damage not in ("other bytes", "gone", "other name"):
        monkeypatch.setitem(corpora.MD5, "test-clean", hashlib.md5(path.read_bytes()).hexdigest())
    assert run("--output", tmp_path / "data", "--archives", path) == 1
    error = capsys.readouterr().err
    assert error.startswith("corpora: ") and error.count("\n") == 1
    assert re.search(says, error)


def test_no_path_inside_an_archive_decides_where_anything_is_written(tmp_path: Path) -> None:
    path = pack(
        tmp_path / "test-clean.tar.gz",
        {"../../a-1-0000.flac": encoded(sound(0), "FLAC"), "a-1.trans.txt": b"a-1-0000 HI\n"},
    )
    target = tmp_path / "in" / "deep" / "here.flac"
    assert corpora.take(path, {"a-1-0000": target}) == {"a-1-0000": (0.5, "hi")}
    assert [file for file in tmp_path.rglob("*.flac")] == [target]


def test_robot_takes_renderings_of_any_rate_and_says_which_is_missing(
    given: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "renderings"
    tone = 0.5 * np.sin(2 * np.pi * 440 * np.arange(24000) / 24000)
    for place in ("af_one/000.wav", "val/bm_two/000.flac"):
        (folder / place).parent.mkdir(parents=True)
        sf.write(folder / place, tone, 24000)
    assert run("--output", tmp_path / "data", "--renderings", folder) == 1
    assert "holds no af_three/001.flac, .wav or .ogg, expected a rendering of 'the last'" in capsys.readouterr().err
    (folder / "af_three").mkdir()
    sf.write(folder / "af_three/001.wav", np.stack((tone, tone), axis=1), 24000)
    assert run("--output", tmp_path / "data", "--renderings", folder) == 0
    for name, row in (
        ("train", "af_one/000.flac\taf_one\t1.00\tthe first sentence"),
        ("test", "af_three/001.flac\taf_three\t1.00\tthe last"),
    ):
        assert (tmp_path / "data/robot" / name / "transcripts.tsv").read_text(encoding="utf-8") == row + "\n"
        samples, rate = sf.read(tmp_path / "data/robot" / name / row.split("\t")[0])
        wanted = 0.5 * np.sin(2 * np.pi * 440 * np.arange(RATE) / RATE)
        assert rate == RATE
        np.testing.assert_allclose(samples[200:-200], wanted[200:-200], atol=2e-4)  # the resampler's ripple


def test_voices_are_rendered_in_their_own_english(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Kokoro:
        def __init__(self, model: str, voices: str) -> None:
            self.files = model, voices

        def create(self, text: str, voice: str, speed: float, lang: str) -> tuple[np.ndarray, int]:
            return np.array([len(text), speed, {"en-us": 1, "en-gb": 2}[lang]]), 24000

    monkeypatch.setitem(sys.modules, "kokoro_onnx", type(sys)("kokoro_onnx"))
    sys.modules["kokoro_onnx"].Kokoro = Kokoro
    render = corpora.kokoro(tmp_path / "m.onnx", tmp_path / "v.bin")
    for voice, code in (("af_one", 1), ("bm_two", 2)):
        samples, rate = render(corpora.Sentence("test", voice, 0, "four"))
        assert samples.tolist() == [4, 1, code] and rate == 24000


def test_whisper_is_converted_by_the_published_converter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source, programs = tmp_path / "whisper-base", tmp_path / "bin"
    assert run("--output", tmp_path / "data", "--whisper", source) == 1
    assert "expected a download of openai/whisper-base" in capsys.readouterr().err
    source.mkdir()
    programs.mkdir()
    for name in ("config.json", "tokenizer.json"):
        (source / name).write_text("{}")
    monkeypatch.setenv("PATH", str(programs))
    assert run("--output", tmp_path / "data", "--whisper", source) == 1
    assert "pip install ctranslate2 transformers torch" in capsys.readouterr().err
    program = programs / corpora.CONVERTER
    lines = [
        f"#!{sys.executable}",
        "import pathlib, sys",
        "folder = pathlib.Path(sys.argv[sys.argv.index('--output_dir') + 1])",
    ]
    program.write_text(
        "\n".join([*lines, "folder.mkdir()", "(folder / 'model.bin').write_text(' '.join(sys.argv[1:3]))", ""])
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    assert run("--output", tmp_path / "data", "--whisper", source) == 0
    assert (tmp_path / "data/whisper/model.bin").read_text() == f"--model {source}"
    program.write_text(f"#!{sys.executable}\nraise SystemExit('not this model')\n")
    (tmp_path / "data/whisper/model.bin").unlink()
    assert run("--output", tmp_path / "data", "--whisper", source) == 1
    assert "ct2-transformers-converter failed: not this model" in capsys.readouterr().err


def test_the_shipped_selection_keeps_test_speakers_and_voices_apart() -> None:
    chosen, read = corpora.read_selection(), corpora.read_sentences()
    for items, who in ((chosen, "speaker"), (read, "voice")):
        sets = {name: {getattr(item, who) for item in items if item.folder == name} for name in corpora.SETS}
        assert not (sets["train"] & sets["test"] or sets["val"] & sets["test"] or sets["train"] & sets["val"])
    counts = {name: sum(u.folder == name for u in chosen) for name in corpora.SETS}
    assert counts == {"train": 2851, "val": 92, "test": 120}
    assert {name: sum(s.folder == name for s in read) for name in corpora.SETS} == {"train": 549, "val": 36, "test": 72}
    assert len({(u.folder, u.path) for u in chosen}) == len(chosen) and len({(s.folder, s.path) for s in read}) == len(
        read
    )


def test_nothing_to_do_is_wrong_usage(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="2"):
        run("--output", tmp_path)
