r"""Build HUMAN, ROBOT and WHISPER, the folders that every benchmark and training starts from, out of public downloads.

    python -m bench.simulate.corpora --output DATA --archives train-clean-100.tar.gz test-clean.tar.gz \
        test-other.tar.gz speechocean762.tar.gz
    python -m bench.simulate.corpora --output DATA --kokoro kokoro-v1.0.int8.onnx voices-v1.0.bin  (or --renderings DIR)
    python -m bench.simulate.corpora --output DATA --whisper whisper-base

Archives: LibriSpeech (openslr.org/12) and speechocean762 (openslr.org/101), as they were downloaded. DATA/human/train,
val and test are each made when all archives of theirs were given; DATA/robot likewise has train, val and test, each
with a transcripts.tsv (path, speaker, seconds, text). Which recordings and sentences: selection.tsv and
robot_sentences.tsv beside this file. --whisper takes the folder of openai/whisper-base and converts it to DATA/whisper
(needs ct2-transformers-converter). Nothing is fetched.

LibriSpeech's archives are held against the checksums published with them. All that was read and made is written down in
DATA/checksums.tsv (what, files, bytes, sha256); --checksums FILE, somebody else's such file, is compared with it: exit
code 1 and a line for each difference. Renderings and Whisper's conversion depend on versions of their packages,
recordings on nothing.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from bench import results_writer
from bench.simulate import archives, robot_voices
from bench.simulate.selection import Utterance, read_selection, read_sentences
from edgefilter.errors import EdgefilterError, UsageError

CONVERTER = "ct2-transformers-converter"
SETS = ("train", "val", "test")
Sums = dict[str, dict[str, object]]
"""files, bytes, sha256 by what was read or made."""


def human(given: Sequence[Path], output: Path) -> tuple[Sums, list[str]]:
    """Write DATA/human; returns checksums and a line for each set that was left out for want of an archive."""
    selected = read_selection()
    by_name = {archives.archive_name(path): path for path in given}
    if strange := set(by_name) - {utterance.archive for utterance in selected}:
        known = ", ".join(sorted({utterance.archive for utterance in selected}))
        raise UsageError(
            f"nothing is taken from {', '.join(sorted(strange))}, expected archives called {known}: keep their names"
        )
    needed = {name: {u.archive for u in selected if u.folder == name} for name in SETS}
    complete = [name for name in SETS if needed[name] <= set(by_name)]
    left_out = [
        f"human/{name} needs {', '.join(sorted(needed[name] - set(by_name)))} as well"
        for name in SETS
        if name not in complete
    ]
    chosen = [utterance for utterance in selected if utterance.folder in complete]
    sums: Sums = {}
    found: dict[tuple[str, str], tuple[float, str]] = {}
    for name, path in by_name.items():
        sums[path.name] = archives.check(path)
        targets = {u.name: output / "human" / u.folder / u.path for u in chosen if u.archive == name}
        found |= {(name, key): value for key, value in (archives.take(path, targets) if targets else {}).items()}
    for name in complete:
        rows = [_row(u, *found[u.archive, u.name]) for u in chosen if u.folder == name]
        sums[f"human/{name}"] = _transcribe(output / "human" / name, rows)
    return sums, left_out


def robot(render: robot_voices.Renderer, output: Path) -> Sums:
    """Write DATA/robot."""
    sums: Sums = {}
    sentences = read_sentences()
    for name in SETS:
        folder, rows = output / "robot" / name, []
        own = [sentence for sentence in sentences if sentence.folder == name]
        for sentence in tqdm(own, desc=f"robot/{name}", unit="sentence", disable=not sys.stderr.isatty()):
            path, seconds = robot_voices.write(sentence, render, folder)
            rows.append((path, sentence.voice, f"{seconds:.2f}", sentence.text))
        sums[f"robot/{name}"] = _transcribe(folder, rows)
    return sums


def whisper(source: Path, output: Path) -> Sums:
    """Convert the folder of openai/whisper-base to DATA/whisper."""
    if not (source / "config.json").is_file() or not (source / "tokenizer.json").is_file():
        raise UsageError(
            f"{source} holds no config.json and tokenizer.json, expected a download of openai/whisper-base"
        )
    program = shutil.which(CONVERTER)
    if program is None:
        raise UsageError(f"there is no {CONVERTER}: pip install ctranslate2 transformers torch")
    target = output / "whisper"
    options = ["--output_dir", str(target), "--copy_files", "tokenizer.json", "--quantization", "float16", "--force"]
    done = subprocess.run([program, "--model", str(source), *options], capture_output=True, text=True)
    if done.returncode or not (target / "model.bin").is_file():
        raise UsageError(f"{CONVERTER} failed: {' '.join(done.stderr.split())[-300:] or 'no model.bin was written'}")
    return {source.name: results_writer.digest(source), "whisper": results_writer.digest(target)}


def compare(sums: Mapping[str, Mapping[str, object]], wanted: Path) -> list[str]:
    """A line for each entry of both that differs."""
    with wanted.open(encoding="utf-8", newline="") as lines:
        others = {row["what"]: row["sha256"] for row in csv.DictReader(lines, delimiter="\t")}
    pairs = ((what, entry["sha256"], others.get(what, entry["sha256"])) for what, entry in sums.items())
    return [f"{what} has the sha256 {own}, {wanted.name} says {other}" for what, own, other in pairs if own != other]


def keep(sums: Sums, path: Path) -> None:
    """Write checksums, those of earlier calls included."""
    if path.is_file():
        with path.open(encoding="utf-8", newline="") as lines:
            sums = {row.pop("what"): row for row in csv.DictReader(lines, delimiter="\t")} | sums
    rows = [f"{what}\t{entry['files']}\t{entry['bytes']}\t{entry['sha256']}" for what, entry in sorted(sums.items())]
    path.write_text("\n".join(["what\tfiles\tbytes\tsha256", *rows]) + "\n", encoding="utf-8")


def _row(utterance: Utterance, seconds: float, text: str) -> tuple[str, str, str, str]:
    return utterance.path, utterance.speaker, f"{seconds:.2f}", text


def _transcribe(folder: Path, rows: Iterable[Sequence[str]]) -> dict[str, object]:
    (folder / "transcripts.tsv").write_text("".join("\t".join(row) + "\n" for row in rows), encoding="utf-8")
    return results_writer.digest(folder)


def build(options: argparse.Namespace) -> int:
    """All that was asked for; 1 where checksums differ."""
    options.output.mkdir(parents=True, exist_ok=True)
    sums: Sums = {}
    if options.archives:
        made, left_out = human(options.archives, options.output)
        sums |= made
        print(*left_out, sep="\n", file=sys.stderr, end="\n" if left_out else "")
    if options.kokoro or options.renderings:
        render = (
            robot_voices.renderings(options.renderings) if options.renderings else robot_voices.kokoro(*options.kokoro)
        )
        sums |= {path.name: results_writer.digest(path) for path in options.kokoro or ()} | robot(
            render, options.output
        )
    if options.whisper:
        sums |= whisper(options.whisper, options.output)
    keep(sums, options.output / "checksums.tsv")
    for what, entry in sums.items():
        print(f"{what}: {entry['files']} files, {entry['bytes']} bytes, sha256 {entry['sha256']}")
    differences = compare(sums, options.checksums) if options.checksums else []
    print(*differences, sep="\n", file=sys.stderr, end="\n" if differences else "")
    return 1 if differences else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, metavar="DATA")
    parser.add_argument(
        "--archives",
        type=Path,
        nargs="+",
        metavar="ARCHIVE",
        help="of LibriSpeech and speechocean762, names as published",
    )
    voices = parser.add_mutually_exclusive_group()
    voices.add_argument("--kokoro", type=Path, nargs=2, metavar=("MODEL", "VOICES"), help="render the robot's voices")
    voices.add_argument(
        "--renderings", type=Path, metavar="DIR", help="take them from DIR/VOICE/NNN.wav, .flac or .ogg"
    )
    parser.add_argument("--whisper", type=Path, metavar="DIR", help="a download of openai/whisper-base")
    parser.add_argument("--checksums", type=Path, metavar="FILE", help="compare with this checksums.tsv")
    options = parser.parse_args()
    if not (options.archives or options.kokoro or options.renderings or options.whisper):
        parser.error("nothing to build from: give --archives, --kokoro, --renderings or --whisper")
    try:
        return build(options)
    except (EdgefilterError, OSError) as error:
        print(f"corpora: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
