"""Which recordings of public corpora are HUMAN/train, val and test, and which sentences the robot's voices read.

selection.tsv: set, archive, speaker, chapter (empty for speechocean762), utterances ("0-4,9"). robot_sentences.tsv:
set, voice, number, text. Both are in the order of the transcripts that they lead to: what is simulated from a folder
draws by position.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

SELECTION = Path(__file__).with_name("selection.tsv")
SENTENCES = Path(__file__).with_name("robot_sentences.tsv")
SPEECHOCEAN = "speechocean762"


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
    """What one of the robot's voices reads."""

    folder: str
    voice: str
    number: int
    text: str

    @property
    def path(self) -> str:
        """Inside its set's folder, without suffix."""
        return f"{self.voice}/{self.number:03d}"


def read_selection(path: Path = SELECTION) -> list[Utterance]:
    """Every utterance of every set, in order."""
    return [
        Utterance(row["set"], row["archive"], row["speaker"], utterance_name(row, number))
        for row in _rows(path)
        for number in numbers(row["utterances"])
    ]


def read_sentences(path: Path = SENTENCES) -> list[Sentence]:
    """Every sentence of every voice, in order."""
    return [Sentence(row["set"], row["voice"], int(row["number"]), row["text"]) for row in _rows(path)]


def utterance_name(row: dict[str, str], number: int) -> str:
    """LibriSpeech: SPEAKER-CHAPTER-NNNN; speechocean762: the speaker in five digits, the utterance in four."""
    if row["archive"] == SPEECHOCEAN:
        return f"{int(row['speaker']):05d}{number:04d}"
    return f"{row['speaker']}-{row['chapter']}-{number:04d}"


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
