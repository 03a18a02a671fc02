"""Speech, noises and responses as one archive that fits beside the checkout, and from there into a device's memory.

    python -m export.gpu.speech --humans DIR ... --robots DIR --validation-humans DIR --validation-robots DIR
        [--noise DIR] [--responses DIR] --output speech.zip

What is Opus already is taken as it is, all else becomes Opus but for responses, which are kept; to read it, soundfile with
libsndfile 1.0.29 or later is needed. Of each kind utterances are taken from every speaker in turn, those first of whom
there is most, until its share of the bytes is used.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np
import soundfile as sf
import torch
from torch import Tensor

from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE, Samples
from export.corpus import ENDINGS, Corpus, read_corpus, read_speech
from export.simulate.material import Material, read_noises, read_responses

MOST_BYTES, SPARE_BYTES = 64 << 20, 4 << 20
"""What checkout, archive and the packages that are missing there may take together; of it, for the packages and for names."""
SHARES = {"human/train": 0.55, "robot/train": 0.23, "human/val": 0.06, "robot/val": 0.04, "noise": 0.12}
"""Of the bytes: more voices of humans than of robots, and of validation as much as 64 conversations use."""
PEAK = 0.5
"""Largest sample of an utterance in memory, as the simulation on processors has it."""


def left(root: Path) -> int:
    """Bytes that the files of the checkout leave of MOST_BYTES; raises UsageError where git knows of none."""
    asked = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True)
    if asked.returncode:
        raise UsageError(f"{root} is no checkout, so that nobody knows what it leaves: give --bytes")
    listed = asked.stdout
    tracked = [root / name for name in listed.split("\0") if name]
    return MOST_BYTES - SPARE_BYTES - sum(path.stat().st_size for path in tracked if path.is_file())


def pack(folders: dict[str, list[Path]], responses: list[Path], output: Path, most: int) -> dict[str, float]:
    """Write the archive; folders: of each of SHARES. Returns the seconds of each kind; raises UsageError for too little room."""
    if most < 1:
        raise UsageError(f"the checkout leaves {most} bytes, expected some: give --bytes, or carry less")
    seconds = {}
    with zipfile.ZipFile(output, "w", zipfile.ZIP_STORED) as archive:
        for kind, share in SHARES.items():
            if not folders.get(kind):
                continue
            room, table, seconds[kind] = share * most, [], 0.0
            for speaker, path in _in_turn(kind, folders[kind]):
                opus = _opus(path)
                room -= len(opus)
                if room < 0:
                    break
                name = f"{len(table):05d}.ogg"
                length = sf.info(io.BytesIO(opus)).duration
                archive.writestr(f"{kind}/{name}", opus)
                table.append(f"{name}\t{speaker}\t{length:.2f}\n")
                seconds[kind] += length
            if kind != "noise":
                archive.writestr(f"{kind}/transcripts.tsv", "".join(table))
        for path in (path for folder in responses for path in sorted(folder.rglob("*")) if path.suffix in ENDINGS):
            archive.write(path, f"rir/{path.parent.name}/{path.name}")
    return seconds


def _in_turn(kind: str, folders: list[Path]) -> Iterator[tuple[str, Path]]:
    """Speaker and path of an utterance of each speaker, then of a second one of each, and so on."""
    if kind == "noise":
        sounds = [path for folder in folders for path in sorted(folder.rglob("*")) if path.suffix in ENDINGS]
        order = np.random.default_rng(0).permutation(len(sounds))
        return ((kind, sounds[at]) for at in order)
    corpus = read_corpus(*folders)
    speakers = sorted(corpus.speakers, key=lambda speaker: -corpus.seconds.get(speaker, 0.0))
    rounds = zip_longest(*([(speaker, path) for path in corpus.speakers[speaker]] for speaker in speakers))
    return (each for one in rounds for each in one if each)


def _opus(path: Path) -> bytes:
    if path.suffix == ".ogg" and sf.info(path).subtype == "OPUS":
        return path.read_bytes()
    samples, rate = sf.read(path, dtype="float32")
    written = io.BytesIO()
    sf.write(written, samples, rate, format="OGG", subtype="OPUS")
    return written.getvalue()


@dataclass(frozen=True, eq=False)
class Voices:
    """Utterances in a device's memory: samples (n,) int16, all one behind the other; spans: [start, end] by speaker."""

    samples: Tensor
    spans: dict[str, list[tuple[int, int]]]
    corpus: Corpus

    def draw(self, rng: np.random.Generator, speaker: str, most: int) -> Tensor:
        """One utterance of that speaker, its first samples, at most so many, (n,) float32."""
        spans = self.spans[speaker]
        start, end = spans[int(rng.integers(len(spans)))]
        return self.samples[start : min(end, start + most)].float() / 32767


@dataclass(frozen=True, eq=False)
class Sounds:
    """An archive, unpacked: voices of humans and robots, noise (n,) all one behind the other, and measured responses."""

    humans: Voices
    robots: Voices
    noise: Tensor
    measured: Material


def read(folder: Path, split: str, device: torch.device) -> Sounds:
    """Read the sounds of one split, "train" or "val", from the folder of the unpacked archive."""
    humans, robots = (_voices(read_corpus(folder / who / split), device) for who in ("human", "robot"))
    noises = read_noises(folder / "noise") if (folder / "noise").is_dir() else ()
    responses = read_responses(folder / "rir") if (folder / "rir").is_dir() else {}
    noise = np.concatenate([sound / max(float(np.abs(sound).max()), 1e-6) for sound in noises] or [np.zeros(1)])
    empty = Corpus({})
    material = Material(empty, empty, [], (), responses)
    return Sounds(humans, robots, torch.from_numpy(noise.astype(np.float32)).to(device), material)


def _voices(corpus: Corpus, device: torch.device) -> Voices:
    def one(path: Path) -> Samples:
        sound = read_speech(path)
        return np.round(32767 * PEAK / max(float(np.abs(sound).max()), 1e-6) * sound).astype(np.int16)

    spans: dict[str, list[tuple[int, int]]] = {}
    sounds, at = [], 0
    paths = [(speaker, path) for speaker, theirs in corpus.speakers.items() for path in theirs]
    with ThreadPoolExecutor() as threads:
        for (speaker, _), sound in zip(paths, threads.map(one, [path for _, path in paths]), strict=True):
            spans.setdefault(speaker, []).append((at, at + sound.size))
            sounds.append(sound)
            at += sound.size
    return Voices(torch.from_numpy(np.concatenate(sounds)).to(device), spans, corpus)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options = {"human/train": "humans", "robot/train": "robots", "human/val": "validation-humans"}
    options |= {"robot/val": "validation-robots", "noise": "noise"}
    for kind, name in options.items():
        parser.add_argument(f"--{name}", type=Path, nargs="+", required=kind != "noise", metavar="DIR", dest=kind)
    parser.add_argument("--responses", type=Path, nargs="*", default=[], metavar="DIR")
    parser.add_argument("--bytes", type=int, help="of the archive (default: what the checkout leaves of 64 MiB)")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.zip")
    chosen = parser.parse_args(argv)
    try:
        most = left(Path(__file__).parents[2]) if chosen.bytes is None else chosen.bytes
        seconds = pack({kind: getattr(chosen, kind) for kind in options}, chosen.responses, chosen.output, most)
    except (EdgefilterError, OSError) as error:
        print(f"speech: {error}", file=sys.stderr)
        return 1
    said = ", ".join(f"{kind} {length / 60:.0f} min" for kind, length in seconds.items())
    print(f"{chosen.output}: {chosen.output.stat().st_size / 1e6:.1f} MB at {SAMPLE_RATE} Hz: {said}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
