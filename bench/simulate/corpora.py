r"""Build HUMAN, ROBOT and WHISPER, the folders that every benchmark and training starts from, out of public downloads.

    python -m bench.simulate.corpora --output DATA --archives train-clean-100.tar.gz test-clean.tar.gz \
        test-other.tar.gz speechocean762.tar.gz
    python -m bench.simulate.corpora --output DATA --kokoro kokoro-v1.0.int8.onnx voices-v1.0.bin  (or --renderings DIR)
    python -m bench.simulate.corpora --output DATA --whisper whisper-base
    python -m bench.simulate.corpora --output DATA --synthesizers

Archives: LibriSpeech (openslr.org/12) and speechocean762 (openslr.org/101), as they were downloaded. DATA/human/train,
val and test are each made when all archives of theirs were given; DATA/robot has the same. Each has a transcripts.tsv
(path, speaker, seconds, text). selection.tsv (set, archive, speaker, chapter, utterances such as "0-4,9") and
robot_sentences.tsv (set, voice, number, text) beside this file say what is taken, in the order of the transcripts: what
is simulated from a folder draws by position. --whisper converts a folder of openai/whisper-base to DATA/whisper.
--synthesizers: espeak-ng and flite read the robot's sentences into DATA/synthesizers. Nothing is fetched.

All that was read and made is written down in DATA/checksums.tsv (what, files, bytes, sha256); --checksums FILE,
somebody else's, is compared with it: exit code 1 and a line for each difference. Renderings and Whisper's conversion
depend on versions of their packages, recordings on nothing.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path, PurePosixPath

import numpy as np
import soundfile as sf
import soxr

from bench.recordings import progress
from bench.results import digest
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE

SELECTION = Path(__file__).with_name("selection.tsv")
SENTENCES = Path(__file__).with_name("robot_sentences.tsv")
SPEECHOCEAN = "speechocean762"
CONVERTER = "ct2-transformers-converter"
SETS = ("train", "val", "test")
SUFFIXES = (".flac", ".wav", ".ogg")
MD5 = {
    "train-clean-100": "2a93770f6d5c6c964bc36631d331a522",
    "test-clean": "32fa31d27d2e1cad72775fee3f4849a9",
    "test-other": "fb5a50374b501bb3bac4815ee91d3135",
}
"""As published with LibriSpeech (md5sum.txt of OpenSLR 12). OpenSLR 101 publishes none for speechocean762."""
ESPEAK = ("en-gb+m3", "en-us+f3", "en-gb-scotland+m1", "en-gb-x-rp+f2", "en-us+m7", "en-029+f4", "en-gb-x-gbcwmd+m5")
FLITE = ("kal16", "awb", "rms", "slt")
SYNTHESIZED = (*(f"espeak-{voice}" for voice in ESPEAK), *(f"flite-{voice}" for voice in FLITE))
"""Voices that read the sentences in turn, each sentence READ times."""
READ, WORDS_A_MINUTE = 3, 165
Sums = dict[str, dict[str, object]]
"""files, bytes, sha256 by what was read or made."""


@dataclass(frozen=True)
class Utterance:
    """One recording that is taken. archive: its name without .tar.gz. name: the corpus's own, without suffix."""

    folder: str
    archive: str
    number: str
    name: str

    @property
    def speaker(self) -> str:
        """As the transcripts call the speaker; the two corpora number theirs independently."""
        return f"so{self.number}" if self.archive == SPEECHOCEAN else self.number

    @property
    def path(self) -> str:
        """Inside its set's folder."""
        where = f"ls{self.number}" if self.folder == "train" and self.archive != SPEECHOCEAN else self.speaker
        return f"{where}/{self.name}.flac"


@dataclass(frozen=True)
class Sentence:
    folder: str
    voice: str
    number: int
    text: str

    @property
    def path(self) -> str:
        """Inside its set's folder, without suffix."""
        return f"{self.voice}/{self.number:03d}"


Renderer = Callable[[Sentence], tuple[np.ndarray, int]]
"""A sentence's samples (n,) and their rate."""


def read_selection(path: Path = SELECTION) -> list[Utterance]:
    found = []
    for row in _rows(path):
        libri = row["archive"] != SPEECHOCEAN
        stem = f"{row['speaker']}-{row['chapter']}-" if libri else f"{int(row['speaker']):05d}"
        names = [f"{stem}{number:04d}" for number in numbers(row["utterances"])]
        found += [Utterance(row["set"], row["archive"], row["speaker"], name) for name in names]
    return found


def read_sentences(path: Path = SENTENCES) -> list[Sentence]:
    return [Sentence(row["set"], row["voice"], int(row["number"]), row["text"]) for row in _rows(path)]


def numbers(text: str) -> list[int]:
    """Numbers from a list of numbers and ranges.

    >>> numbers("0-2,9")
    [0, 1, 2, 9]
    """
    parts = [part.split("-") for part in text.split(",")]
    return [number for first, *last in parts for number in range(int(first), int(last[0] if last else first) + 1)]


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE))


def archive_name(path: Path) -> str:
    """What an archive is called without its suffixes.

    >>> archive_name(Path("downloads/test-clean.tar.gz"))
    'test-clean'
    """
    return path.name.split(".tar")[0]


def check(path: Path) -> dict[str, object]:
    """Bytes and sha256 of an archive; raises UsageError where its publisher's MD5 is known and another one."""
    md5, sha256 = hashlib.md5(usedforsecurity=False), hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(1 << 20):
                md5.update(chunk)
                sha256.update(chunk)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; expected a downloaded archive") from None
    wanted = MD5.get(archive_name(path))
    if wanted and md5.hexdigest() != wanted:
        raise UsageError(f"{path} has the MD5 {md5.hexdigest()}, expected {wanted}: download it again")
    return {"files": 1, "bytes": path.stat().st_size, "sha256": sha256.hexdigest()}


def take(archive: Path, wanted: Mapping[str, Path]) -> dict[str, tuple[float, str]]:
    """Write recordings of a tar archive where they are wanted, as FLAC, and return their seconds and texts.

    wanted: the file to write by the recording's name without suffix; no path inside the archive decides where
    anything is written. LibriSpeech keeps texts in SPEAKER-CHAPTER.trans.txt, speechocean762 in files called `text`;
    both have a name and the words in a line. Raises UsageError for what is no tar archive, for a recording that is
    not 16 kHz mono, and where one or its text is missing.
    """
    seconds: dict[str, float] = {}
    texts: dict[str, str] = {}
    try:
        with tarfile.open(archive, "r|*") as members:
            for member in members:
                place = PurePosixPath(member.name)
                if not member.isfile():
                    continue
                if place.stem in wanted and place.suffix.lower() in (".flac", ".wav"):
                    content = members.extractfile(member).read()
                    seconds[place.stem] = _write(content, wanted[place.stem], f"{archive}:{place}")
                elif place.name.endswith(".trans.txt") or place.name == "text":
                    lines = members.extractfile(member).read().decode("utf-8").splitlines()
                    named = map(str.split, filter(None, lines))
                    texts |= {name: " ".join(words) for name, *words in named if name in wanted}
    except (tarfile.TarError, EOFError) as error:
        raise UsageError(f"{archive} cannot be read as a tar archive ({error}): download it again") from None
    for what, found in (("recordings", seconds), ("texts", texts)):
        if missing := [name for name in wanted if name not in found]:
            lacks = f"{archive} lacks {len(missing)} of {len(wanted)} {what}, {missing[0]} first"
            raise UsageError(f"{lacks}: is it the right archive?")
    return {name: (seconds[name], texts[name].lower()) for name in wanted}


def _write(content: bytes, path: Path, name: str) -> float:
    """Write FLAC; what is FLAC already stays bit for bit. Returns its length in seconds."""
    about = sf.info(io.BytesIO(content))
    if about.samplerate != SAMPLE_RATE or about.channels != 1:
        found = f"{about.samplerate} Hz and {about.channels} channels"
        raise UsageError(f"{name} has {found}, expected {SAMPLE_RATE} Hz mono")
    path.parent.mkdir(parents=True, exist_ok=True)
    if about.format == "FLAC":
        path.write_bytes(content)
    else:
        sf.write(path, sf.read(io.BytesIO(content), dtype="int16")[0], SAMPLE_RATE, subtype="PCM_16")
    return about.frames / SAMPLE_RATE


def human(given: Sequence[Path], output: Path) -> tuple[Sums, list[str]]:
    """Write DATA/human; returns checksums and a line for each set that was left out because an archive is missing."""
    selected = read_selection()
    by_name = {archive_name(path): path for path in given}
    if strange := set(by_name) - {utterance.archive for utterance in selected}:
        known = ", ".join(sorted({utterance.archive for utterance in selected}))
        found = f"nothing is taken from {', '.join(sorted(strange))}"
        raise UsageError(f"{found}, expected archives called {known}: keep their names")
    lacking = {name: sorted({u.archive for u in selected if u.folder == name} - set(by_name)) for name in SETS}
    complete = [name for name in SETS if not lacking[name]]
    left_out = [f"human/{name} needs {', '.join(lacking[name])} as well" for name in SETS if lacking[name]]
    chosen = [utterance for utterance in selected if utterance.folder in complete]
    sums: Sums = {}
    found: dict[tuple[str, str], tuple[float, str]] = {}
    for name, path in by_name.items():
        sums[path.name] = check(path)
        targets = {u.name: output / "human" / u.folder / u.path for u in chosen if u.archive == name}
        found |= {(name, key): value for key, value in (take(path, targets) if targets else {}).items()}
    for name in complete:
        rows = [(u.path, u.speaker, *found[u.archive, u.name]) for u in chosen if u.folder == name]
        sums[f"human/{name}"] = _transcribe(output / "human" / name, rows)
    return sums, left_out


def kokoro(model: Path, voices: Path) -> Renderer:
    """Renders with the package kokoro-onnx, British voices (b...) in British English; raises UsageError without it."""
    try:
        from kokoro_onnx import Kokoro
    except ImportError as error:
        remedy = "pip install kokoro-onnx, or give --renderings"
        raise UsageError(f"rendering needs the package kokoro-onnx: {remedy}") from error
    engine = Kokoro(str(model), str(voices))

    def render(sentence: Sentence) -> tuple[np.ndarray, int]:
        language = "en-gb" if sentence.voice.startswith("b") else "en-us"
        return engine.create(sentence.text, voice=sentence.voice, speed=1.0, lang=language)

    return render


def renderings(folder: Path) -> Renderer:
    """What reads FOLDER/VOICE/NNN.flac, .wav or .ogg, or FOLDER/SET/VOICE/..., for a sentence; it raises UsageError where that file is missing."""

    def read(sentence: Sentence) -> tuple[np.ndarray, int]:
        roots = (folder, folder / sentence.folder)
        places = (root / f"{sentence.path}{suffix}" for root in roots for suffix in SUFFIXES)
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            wanted = f"{sentence.path}.flac, .wav or .ogg, expected a rendering of '{sentence.text}'"
            raise UsageError(f"{folder} holds no {wanted}")
        samples, rate = sf.read(found, dtype="float32", always_2d=True)
        return samples.mean(axis=1), rate

    return read


def read_aloud(sentence: Sentence) -> tuple[np.ndarray, int]:
    """Renders with espeak-ng or flite. Raises UsageError where the synthesizer is missing or fails."""
    program, _, voice = sentence.voice.partition("-")
    with tempfile.TemporaryDirectory() as folder:
        output = str(Path(folder) / "spoken.wav")
        espeak = ["espeak-ng", "-v", voice, "-s", str(WORDS_A_MINUTE), "-w", output, sentence.text]
        asked = espeak if program == "espeak" else ["flite", "-voice", voice, "-t", sentence.text, "-o", output]
        try:
            subprocess.run(asked, capture_output=True, check=True)
            return sf.read(output)
        except (OSError, subprocess.CalledProcessError, sf.LibsndfileError) as error:
            raise UsageError(f"{asked[0]} does not speak ({error}): apt-get install espeak-ng flite") from error


def robot(render: Renderer, output: Path) -> Sums:
    of = {name: [sentence for sentence in read_sentences() if sentence.folder == name] for name in SETS}
    return {f"robot/{name}": _render(sentences, render, output / "robot" / name) for name, sentences in of.items()}


def synthesizers(output: Path) -> Sums:
    """Write DATA/synthesizers: the sentences of all sets, each spoken READ times, by one after the other of SYNTHESIZED; checksums."""
    texts, voices = dict.fromkeys(sentence.text for sentence in read_sentences()), cycle(SYNTHESIZED)
    each = ((number, text) for number, text in enumerate(texts) for _ in range(READ))
    sentences = [Sentence("synthesizers", next(voices), number, text) for number, text in each]
    return {"synthesizers": _render(sentences, read_aloud, output / "synthesizers")}


def _render(sentences: Sequence[Sentence], render: Renderer, folder: Path) -> dict[str, object]:
    """Write sentences as 16 kHz FLAC below the folder, and their transcripts."""
    rows = []
    for sentence in progress(sentences, "sentence", folder.name):
        samples, rate = render(sentence)
        samples = np.asarray(samples, np.float32)
        if rate != SAMPLE_RATE:
            samples = soxr.resample(samples, rate, SAMPLE_RATE)
        path = f"{sentence.path}.flac"
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        sf.write(folder / path, np.clip(samples, -1.0, 1.0), SAMPLE_RATE, subtype="PCM_16")
        rows.append((path, sentence.voice, samples.size / SAMPLE_RATE, sentence.text))
    return _transcribe(folder, rows)


def _transcribe(folder: Path, rows: Iterable[tuple[str, str, float, str]]) -> dict[str, object]:
    lines = [f"{path}\t{speaker}\t{seconds:.2f}\t{text}\n" for path, speaker, seconds, text in rows]
    (folder / "transcripts.tsv").write_text("".join(lines), encoding="utf-8")
    return digest(folder)


def whisper(source: Path, output: Path) -> Sums:
    if not (source / "config.json").is_file() or not (source / "tokenizer.json").is_file():
        wanted = "expected a download of openai/whisper-base"
        raise UsageError(f"{source} holds no config.json and tokenizer.json, {wanted}")
    program = shutil.which(CONVERTER)
    if program is None:
        raise UsageError(f"there is no {CONVERTER}: pip install ctranslate2 transformers torch")
    target = output / "whisper"
    options = ["--output_dir", str(target), "--copy_files", "tokenizer.json", "--quantization", "float16", "--force"]
    done = subprocess.run([program, "--model", str(source), *options], capture_output=True, text=True)
    if done.returncode or not (target / "model.bin").is_file():
        raise UsageError(f"{CONVERTER} failed: {' '.join(done.stderr.split())[-300:] or 'no model.bin was written'}")
    return {source.name: digest(source), "whisper": digest(target)}


def compare(sums: Sums, wanted: Path) -> list[str]:
    """A line for each entry of both that differs."""
    others = {row["what"]: row["sha256"] for row in _rows(wanted)}
    pairs = ((what, entry["sha256"], others.get(what, entry["sha256"])) for what, entry in sums.items())
    return [f"{what} has the sha256 {own}, {wanted.name} says {other}" for what, own, other in pairs if own != other]


def keep(sums: Sums, path: Path) -> None:
    """Write checksums, those of earlier calls included."""
    if path.is_file():
        sums = {row.pop("what"): row for row in _rows(path)} | sums
    rows = [f"{what}\t{entry['files']}\t{entry['bytes']}\t{entry['sha256']}" for what, entry in sorted(sums.items())]
    path.write_text("\n".join(["what\tfiles\tbytes\tsha256", *rows]) + "\n", encoding="utf-8")


def build(options: argparse.Namespace) -> int:
    """All that was asked for; 1 where checksums differ."""
    options.output.mkdir(parents=True, exist_ok=True)
    sums: Sums = {}
    if options.archives:
        made, left_out = human(options.archives, options.output)
        sums |= made
        for line in left_out:
            print(line, file=sys.stderr)
    if options.kokoro:
        sums |= {path.name: digest(path) for path in options.kokoro} | robot(kokoro(*options.kokoro), options.output)
    if options.renderings:
        sums |= robot(renderings(options.renderings), options.output)
    if options.synthesizers:
        sums |= synthesizers(options.output)
    if options.whisper:
        sums |= whisper(options.whisper, options.output)
    keep(sums, options.output / "checksums.tsv")
    for what, entry in sums.items():
        print(f"{what}: {entry['files']} files, {entry['bytes']} bytes, sha256 {entry['sha256']}")
    differences = compare(sums, options.checksums) if options.checksums else []
    for line in differences:
        print(line, file=sys.stderr)
    return 1 if differences else 0


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--output", type=Path, required=True, metavar="DATA")
    add("--archives", type=Path, nargs="+", metavar="ARCHIVE", help="of LibriSpeech and speechocean762, as published")
    voices = parser.add_mutually_exclusive_group()
    voices.add_argument("--kokoro", type=Path, nargs=2, metavar=("MODEL", "VOICES"), help="render the robot's voices")
    rendered = "take them from DIR/VOICE/NNN.wav, .flac or .ogg"
    voices.add_argument("--renderings", type=Path, metavar="DIR", help=rendered)
    add("--synthesizers", action="store_true", help="have espeak-ng and flite read the robot's sentences")
    add("--whisper", type=Path, metavar="DIR", help="a download of openai/whisper-base")
    add("--checksums", type=Path, metavar="FILE", help="compare with this checksums.tsv")
    options = parser.parse_args(argv)
    if not (options.archives or options.kokoro or options.renderings or options.synthesizers or options.whisper):
        parser.error("nothing to build from: give --archives, --kokoro, --renderings, --synthesizers or --whisper")
    try:
        return build(options)
    except (EdgefilterError, OSError) as error:
        print(f"corpora: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
